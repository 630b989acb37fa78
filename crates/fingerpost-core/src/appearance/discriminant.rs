//! Fisher's linear discriminant: the mixture of channels in which hand and background differ most.
//!
//! A finger's shaded flank may be as dark as the wood behind it and still differ in colour.
//! Fisher's linear discriminant w = S⁻¹ (μ_hand − μ_background), with S the mean covariance of
//! colours within the two classes, is the mixture of the camera's channels that separates hand and
//! background by the most standard deviations. It is learned from either side of accepted contours;
//! edges are then measured in its image in place of the grey one. There the hand is always the
//! brighter side.
//!
//! A finger lit from one side has one colour and two brightnesses, and its background may have the
//! darker one. Then only *chromaticity* separates them, the channels as parts of the sum of all
//! three, which light of one colour does not change.
//!
//! Source: Fisher 1936, The use of multiple measurements in taxonomic problems.

use crate::Result;
use crate::image::frame::{CHROMATICITY_SUM, Frame, SidedPixel, chromaticity};
use crate::image::gray::GrayView;
use crate::numeric::ablation::{Mechanism, is_off};
use nalgebra::{Matrix3, Point2, Vector3};

/// Variance added to every channel for noise and rounding \[grey levels²\].
const LEAST_VARIANCE: f64 = 1.0;
/// Standard deviation of either class in the discriminant's image, unless [`MOST_CONTRAST`] limits
/// it \[grey levels\]: large enough for the error of rounding to bytes to be negligible.
const CLASS_SIGMA: f64 = 3.0;
/// Least difference hand minus background in the discriminant's image \[grey levels\]: an edge with
/// half of it has the least contrast that counts.
const LEAST_CONTRAST: f64 = 18.0;
/// Largest difference hand minus background in the discriminant's image \[grey levels\]; more would
/// exceed the range of a byte.
const MOST_CONTRAST: f64 = 120.0;
/// Least ratio of the squared separation in colour to that in grey: colour is recorded at a lower
/// resolution.
const BETTER_THAN_GREY: f64 = 1.5;
/// Least separation of the means of hand and background \[standard deviations\]. The means are
/// shown at least [`LEAST_CONTRAST`] apart, so at this separation noise is magnified 288 times; the
/// weights of a mixture, proportional to 1 / separation, overflow their integers below 0.03.
const LEAST_SEPARATION: f64 = 1.0 / 16.0;
/// The same for chromaticities, which are not compared with grey.
const LEAST_CHROMATIC_SEPARATION: f64 = std::f64::consts::SQRT_2;
/// Binary places of the fixed-point weights.
const PLACES: i32 = 12;

/// Sums over the observed colours of one class.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Class {
    weight: f64,
    sum: Vector3<f64>,
    squares: Matrix3<f64>,
    grey: f64,
    grey_squares: f64,
}

/// Sums over the pixels of one frame; none of them can overflow for any number of pixels that fits
/// in memory.
#[derive(Debug, Clone, Copy, Default)]
struct Counts {
    pixels: u64,
    sum: [u64; 3],
    squares: [[u64; 3]; 3],
    grey: u64,
    grey_squares: u64,
}

impl Counts {
    fn add(&mut self, colour: [u64; 3], grey: u8) {
        let grey = u64::from(grey);
        self.pixels += 1;
        self.grey += grey;
        self.grey_squares += grey * grey;
        for (i, &c) in colour.iter().enumerate() {
            self.sum[i] += c;
            for (square, &other) in self.squares[i].iter_mut().zip(&colour) {
                *square += c * other;
            }
        }
    }
}

impl Class {
    fn add(&mut self, counts: &Counts, times: f64) {
        let weighted = |count: u64| times * count as f64;
        self.weight += weighted(counts.pixels);
        self.sum += Vector3::from(counts.sum.map(weighted));
        self.squares += Matrix3::from(counts.squares.map(|row| row.map(weighted)));
        self.grey += weighted(counts.grey);
        self.grey_squares += weighted(counts.grey_squares);
    }

    fn fade(&mut self, keep: f64) {
        self.weight *= keep;
        self.sum *= keep;
        self.squares *= keep;
        self.grey *= keep;
        self.grey_squares *= keep;
    }

    fn relight(&mut self, gain: f64) {
        self.sum *= gain;
        self.squares *= gain * gain;
        self.grey *= gain;
        self.grey_squares *= gain * gain;
    }

    fn and(&self, other: &Self) -> Self {
        Self {
            weight: self.weight + other.weight,
            sum: self.sum + other.sum,
            squares: self.squares + other.squares,
            grey: self.grey + other.grey,
            grey_squares: self.grey_squares + other.grey_squares,
        }
    }

    fn mean(&self) -> Vector3<f64> {
        self.sum / self.weight
    }

    fn covariance(&self) -> Matrix3<f64> {
        self.squares / self.weight - self.mean() * self.mean().transpose()
    }

    fn grey_variance(&self) -> f64 {
        self.grey_squares / self.weight - (self.grey / self.weight).powi(2)
    }
}

/// Fisher's linear discriminant of hand and background, if both were observed.
#[derive(Debug, Clone, Default)]
pub struct Discriminant {
    hand: Class,
    anchor: Class,
    background: Class,
    mixture: Option<Mixture>,
    /// Whether colours are reduced to their chromaticity.
    is_chromatic: bool,
}

/// Weighted sum of a colour's channels, as a grey level.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Mixture {
    weights: [i32; 3],
    offset: i32,
    /// Whether it applies to a colour's chromaticity.
    is_chromatic: bool,
}

impl Discriminant {
    /// A discriminant of chromaticities, which ignores brightness.
    #[must_use]
    pub fn of_chromaticity() -> Self {
        Self { is_chromatic: true, ..Self::default() }
    }

    /// Discards all observations.
    pub fn forget(&mut self) {
        *self = Self { is_chromatic: self.is_chromatic, ..Self::default() };
    }

    /// Scales the weight of the observations by `keep`, 0–1.
    pub fn fade(&mut self, keep: f64) {
        self.hand.fade(keep);
        self.background.fade(keep);
    }

    /// Adapts the observations to light that is `gain` times as bright, and computes the mixture.
    /// Chromaticities do not change.
    pub fn relight(&mut self, gain: f64) {
        if self.is_chromatic {
            return;
        }
        for class in [&mut self.hand, &mut self.anchor, &mut self.background] {
            class.relight(gain);
        }
        self.learn();
    }

    /// Keeps the present model of the hand permanently: it counts as much as all later
    /// observations.
    pub fn anchor(&mut self) {
        self.anchor = self.hand;
    }

    /// Adds the pixel nearest to (u, v), if it lies in the frame and the frame has colours.
    pub fn observe(&mut self, frame: &Frame<'_>, u: f64, v: f64, is_hand: bool) {
        self.observe_all(frame, SidedPixel::at(u, v, is_hand).as_slice(), 1.0);
    }

    /// Adds pixels, all of which lie in the frame, with the weight `times`, if the frame has
    /// colours.
    pub(crate) fn observe_all(&mut self, frame: &Frame<'_>, pixels: &[SidedPixel], times: f64) {
        let Some(colours) = frame.colour() else { return };
        let mut counts = [Counts::default(); 2];
        for &SidedPixel { x, y, is_hand } in pixels {
            let (x, y) = (x as usize, y as usize);
            if let (Some(colour), Some(grey)) = (colours.pixel(x, y), frame.image().pixel(x, y)) {
                let colour = if self.is_chromatic {
                    chromaticity(colour).map(|channel| channel.round() as u64).into()
                } else {
                    colour.map(u64::from)
                };
                counts[usize::from(is_hand)].add(colour, grey);
            }
        }
        self.background.add(&counts[0], times);
        self.hand.add(&counts[1], times);
    }

    /// Computes the mixture.
    pub fn learn(&mut self) {
        self.mixture = self.fisher();
    }

    /// The mixture in whose image the hand is the brighter side; `None` without observations, if
    /// grey separates the hand as well, or if the means of hand and background are closer than 1/16
    /// standard deviation. A mixture of chromaticities is not compared with grey; it is `None` if
    /// the means are closer than √2 standard deviations.
    #[must_use]
    pub fn mixture(&self) -> Option<&Mixture> {
        if is_off(Mechanism::Discriminant) {
            return None;
        }
        self.mixture.as_ref()
    }

    /// Distance between the means of hand and background, in standard deviations within the
    /// classes; 0 without observations.
    #[must_use]
    pub fn separation(&self) -> f64 {
        self.direction().map_or(0.0, |(_, separation2)| separation2.max(0.0).sqrt())
    }

    /// All observations of the hand; `None` unless hand and background were both observed.
    fn hand(&self) -> Option<Class> {
        let hand = self.hand.and(&self.anchor);
        (hand.weight >= 1.0 && self.background.weight >= 1.0).then_some(hand)
    }

    /// Fisher's direction w, and the squared separation wᵀ (μ_hand − μ_background), which is also
    /// the variance of w · colour within the classes.
    fn direction(&self) -> Option<(Vector3<f64>, f64)> {
        let (hand, background) = (self.hand()?, &self.background);
        let scatter = 0.5 * (hand.covariance() + background.covariance())
            + Matrix3::identity() * LEAST_VARIANCE;
        let mean_difference = hand.mean() - background.mean();
        let w = scatter.cholesky()?.solve(&mean_difference);
        Some((w, mean_difference.dot(&w)))
    }

    /// Whether colours of this squared separation show the hand well enough, and better than grey.
    fn is_useful(&self, separation2: f64) -> bool {
        let Some(hand) = self.hand() else { return false };
        let background = &self.background;
        if self.is_chromatic {
            return separation2 >= LEAST_CHROMATIC_SEPARATION.powi(2);
        }
        let grey_difference = hand.grey / hand.weight - background.grey / background.weight;
        let grey_scatter =
            0.5 * (hand.grey_variance() + background.grey_variance()) + LEAST_VARIANCE;
        separation2 >= LEAST_SEPARATION.powi(2)
            && separation2 > BETTER_THAN_GREY * grey_difference.powi(2) / grey_scatter
    }

    fn fisher(&self) -> Option<Mixture> {
        let (hand, background) = (self.hand()?, &self.background);
        let (w, separation2) = self.direction()?;
        if !self.is_useful(separation2) {
            return None;
        }
        let contrast = (CLASS_SIGMA * separation2.sqrt()).clamp(LEAST_CONTRAST, MOST_CONTRAST);
        let gain = contrast / separation2;
        let middle = 0.5 * (hand.mean() + background.mean());
        let unit = f64::from(1 << PLACES);
        let weights = w.map(|w| (w * gain * unit).round());
        // Half a unit is added because the shift rounds down.
        let half = f64::from(1 << (PLACES - 1));
        let offset = ((128.0 - gain * w.dot(&middle)) * unit).round() + half;
        // Means that were adapted to other light may exceed a byte, and the sum its integer.
        let most_channel = if self.is_chromatic { CHROMATICITY_SUM } else { f64::from(u8::MAX) };
        let most = most_channel * weights.abs().sum() + offset.abs();
        (most <= f64::from(i32::MAX)).then(|| Mixture {
            weights: [0, 1, 2].map(|k| weights[k] as i32),
            offset: offset as i32,
            is_chromatic: self.is_chromatic,
        })
    }
}

/// The image of a mixture, computed only where it is used.
#[derive(Debug, Clone, Default)]
pub struct DiscriminantImage {
    pixels: Vec<u8>,
    /// Mixture and region of the present frame that were computed: columns and rows, from and to.
    made: Option<(Mixture, [usize; 4])>,
}

impl DiscriminantImage {
    /// Begins a new frame: nothing of it is computed. To be called before each; see
    /// [`of`](Self::of).
    pub fn clear(&mut self) {
        self.made = None;
    }

    /// Reserves space for a frame, so that nothing is allocated once a hand is known.
    pub(crate) fn reserve(&mut self, frame: &Frame<'_>) {
        let pixels = frame.image().width() * frame.image().height();
        self.pixels.reserve(pixels.saturating_sub(self.pixels.len()));
    }

    /// The frame as a mixture shows it, at least in a region, or the frame itself without a
    /// mixture; see [`of`](Self::of).
    ///
    /// # Errors
    /// Those of [`of`](Self::of).
    pub(crate) fn shown<'a>(
        &'a mut self,
        frame: &Frame<'a>,
        mixture: Option<&Mixture>,
        region: impl FnOnce() -> [f64; 4],
    ) -> Result<Frame<'a>> {
        mixture.map_or(Ok(*frame), |mixture| self.of(frame, mixture, region()))
    }

    /// The frame with the discriminant in place of its grey image, at least in a region: columns
    /// and rows \[px\], from and to. Pixels outside of it have any value.
    ///
    /// A region computed since the last [`clear`](Self::clear) is not computed again. All calls
    /// between two calls of it must therefore pass the same frame: for another one, the pixels of
    /// the first may be shown. Call [`clear`](Self::clear) before the first call of each frame.
    ///
    /// # Errors
    /// None for a frame that was constructed; a frame without colours is returned unchanged.
    pub fn of<'a>(
        &'a mut self,
        frame: &Frame<'a>,
        mixture: &Mixture,
        region: [f64; 4],
    ) -> Result<Frame<'a>> {
        let Some(colour) = frame.colour() else { return Ok(*frame) };
        let (width, height) = (frame.image().width(), frame.image().height());
        self.pixels.resize(width * height, 0);
        let [left, right, top, bottom] = region;
        let requested = [
            left.floor().clamp(0.0, width as f64) as usize,
            (right.ceil() + 1.0).clamp(0.0, width as f64) as usize,
            top.floor().clamp(0.0, height as f64) as usize,
            (bottom.ceil() + 1.0).clamp(0.0, height as f64) as usize,
        ];
        let made = self.made.filter(|(by, _)| by == mixture).map(|(_, made)| made);
        if !made.is_some_and(|m| covers(&m, &requested)) {
            let needed = made.map_or(requested, |m| hull(&m, &requested));
            let [x0, x1, y0, y1] = needed;
            for y in y0..y1 {
                let known = made.filter(|m| (m[2]..m[3]).contains(&y));
                let missing = known.map_or([x0..x1, x1..x1], |m| [x0..m[0], m[1]..x1]);
                let pixels = self.pixels.get_mut(y * width..(y + 1) * width);
                let (Some(pixels), Some(colours)) = (pixels, colour.row(y)) else { continue };
                for columns in missing {
                    mixture.mix(&colours[3 * columns.start..], &mut pixels[columns]);
                }
            }
            self.made = Some((*mixture, needed));
        }
        Frame::coloured(GrayView::new(&self.pixels, width, height, width)?, *colour)
    }
}

/// Bounds of the neighbourhoods of some points \[px\]: columns and rows, from and to.
pub(crate) fn region_about(points: impl Iterator<Item = (Point2<f64>, f64)>) -> [f64; 4] {
    let empty = [f64::INFINITY, f64::NEG_INFINITY, f64::INFINITY, f64::NEG_INFINITY];
    points.fold(empty, |[left, right, top, bottom], (p, reach)| {
        [
            left.min(p.x - reach),
            right.max(p.x + reach),
            top.min(p.y - reach),
            bottom.max(p.y + reach),
        ]
    })
}

fn covers(made: &[usize; 4], requested: &[usize; 4]) -> bool {
    made[0] <= requested[0]
        && made[1] >= requested[1]
        && made[2] <= requested[2]
        && made[3] >= requested[3]
}

fn hull(a: &[usize; 4], b: &[usize; 4]) -> [usize; 4] {
    [a[0].min(b[0]), a[1].max(b[1]), a[2].min(b[2]), a[3].max(b[3])]
}

impl Mixture {
    /// The grey level of a colour.
    pub(crate) fn of(&self, colour: [u8; 3]) -> u8 {
        let sum = if self.is_chromatic {
            let weights = Vector3::from(self.weights.map(f64::from));
            // The cast truncates and the shift rounds down; below zero both end at black.
            weights.dot(&chromaticity(colour)) as i32
        } else {
            let [a, b, c] = self.weights;
            let [x, y, z] = colour.map(i32::from);
            a * x + b * y + c * z
        };
        ((sum + self.offset) >> PLACES).clamp(0, 255) as u8
    }

    /// Mixes a row of interleaved colours.
    fn mix(&self, colours: &[u8], row: &mut [u8]) {
        for (grey, colour) in row.iter_mut().zip(colours.as_chunks::<3>().0) {
            *grey = self.of(*colour);
        }
    }
}
