//! Refinement of one band candidate: its pose, and the contrast of its inside with its
//! surroundings.

use crate::appearance::background::ForegroundMap;
use crate::geometry::template::Thumb;
use crate::image::frame::{Frame, chromaticity};
use nalgebra::Matrix3;
use nalgebra::Point2;
use nalgebra::Vector2;
use nalgebra::Vector3;
use std::f64::consts::PI;
use std::f64::consts::TAU;

/// Half-width of the sampled core of a band, as a part of the band's.
pub(super) const CORE_HALF_WIDTH_PART: f64 = 0.55;
/// Extent of the core across the band, in parts of its half-width.
pub(super) const WHOLE_CORE: (f64, f64) = (-1.0, 1.0);
/// Distance from the axis at which one half of the core begins, in the same unit.
pub(super) const HALF_CORE_FROM: f64 = 0.2;
/// Distance \[half-widths\] and angle \[rad\] within which two candidates are the same.
pub(super) const SAME_PLACE_HALF_WIDTHS: f64 = 1.5;
pub(super) const SAME_ANGLE_RAD: f64 = 0.5;

/// Ranges of a thumb's angle to its finger \[rad\], of the distance from the fingertip back to the
/// intersection of the axes, of the distance from there to the thumb's tip \[both in finger
/// half-widths\], and of its width as a part of the finger's.
pub(super) const THUMB_ANGLES_RAD: (f64, f64) = (0.5, 1.95);
pub(super) const THUMB_ROOTS: (f64, f64) = (5.0, 20.0);
pub(super) const THUMB_TIPS: (f64, f64) = (2.5, 16.0);
pub(super) const THUMB_WIDTHS: (f64, f64) = (0.6, 1.7);

/// A possible pointing hand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// The finger's tip \[px\].
    pub tip_px: Point2<f64>,
    /// Pointing direction \[rad\], from +u (right) towards +v (down).
    pub angle_rad: f64,
    /// Visible length of the finger \[px\].
    pub length_px: f64,
    /// Half its width \[px\].
    pub half_width_px: f64,
    /// Side of a second band that may be its thumb.
    pub thumb: Thumb,
    /// Mean colour of its inside, in the order of the frame's channels; a grey level repeated three
    /// times.
    pub colour: [f64; 3],
    /// Mean foreground probability of its inside, 0–1; 0 while no background is known.
    pub foreground: f64,
    /// Likeness to a finger by shape and colours alone, 0–1.
    pub score: f64,
}

/// A band of the coarse search.
#[derive(Debug, Clone, Copy)]
pub(super) struct Band {
    pub(super) tip: Point2<f64>,
    pub(super) angle_rad: f64,
    pub(super) half_width_px: f64,
    pub(super) score: f64,
    /// The score, increased in the foreground.
    pub(super) weight: f64,
}

/// A refined band.
#[derive(Debug, Clone, Copy)]
pub(super) struct RefinedCandidate {
    band: Band,
    length_px: f64,
    colour: Vector3<f64>,
    foreground: f64,
    pub(super) score: f64,
}

impl RefinedCandidate {
    /// The candidate, with its score raised by the part `bonus` of its difference from 1, for a
    /// thumb.
    pub(super) fn candidate(&self, thumb: Thumb, bonus: f64) -> Candidate {
        Candidate {
            tip_px: self.band.tip,
            angle_rad: self.band.angle_rad,
            length_px: self.length_px,
            half_width_px: self.band.half_width_px,
            thumb,
            colour: self.colour.into(),
            foreground: self.foreground,
            score: (self.score + bonus * (1.0 - self.score)).min(1.0),
        }
    }

    pub(super) fn is_same(&self, other: &Self) -> bool {
        let (a, b) = (&self.band, &other.band);
        let turn_rad = (a.angle_rad - b.angle_rad + PI).rem_euclid(TAU) - PI;
        (a.tip - b.tip).norm() < SAME_PLACE_HALF_WIDTHS * a.half_width_px.max(b.half_width_px)
            && turn_rad.abs() < SAME_ANGLE_RAD
    }

    /// Side on which another band could be this finger's thumb, and that band's score.
    pub(super) fn thumb(&self, other: &Self) -> Option<(Thumb, f64)> {
        let (a, b) = (&self.band, &other.band);
        let w = a.half_width_px;
        let within = |x: f64, (low, high): (f64, f64)| x >= low && x <= high;
        let (sin, cos) = a.angle_rad.sin_cos();
        let (e, n) = (Vector2::new(cos, sin), Vector2::new(-sin, cos));
        let to = b.tip - a.tip;
        let across = to.dot(&n);
        let (sin, cos) = b.angle_rad.sin_cos();
        let direction = Vector2::new(cos, sin);
        let side = across.signum();
        // Both directions point away from the intersection of the axes.
        let turned = (side * direction.dot(&n)).atan2(direction.dot(&e));
        if !within(turned, THUMB_ANGLES_RAD) || !within(b.half_width_px / w, THUMB_WIDTHS) {
            return None;
        }
        let root = across / direction.dot(&n);
        let meet = -(to - direction * root).dot(&e) / w;
        let reaches = within(meet, THUMB_ROOTS) && within(root / w, THUMB_TIPS);
        let thumb = if side < 0.0 { Thumb::Left } else { Thumb::Right };
        reaches.then_some((thumb, other.score))
    }
}

/// Rotations tried about the coarse angle \[rad\], and the rotation at which the weight of a trial
/// falls to 0.
const TURNS_RAD: [f64; 7] = [0.0, -0.1, 0.1, -0.2, 0.2, -0.3, 0.3];
const TURN_REACH_RAD: f64 = 0.5;
/// Thresholds of the squared Mahalanobis distance from the inside's colours above which a pixel has
/// another colour: for three channels and for one.
const UNLIKE_COLOUR: f64 = 6.0;
const UNLIKE_GREY: f64 = 4.0;
/// Standard deviation added to the inside's colours \[grey levels\].
const COLOUR_FLOOR: f64 = 4.0;
/// Largest ratio of brightness between the halves of a finger that is lit from one side.
const HALF_LIT: f64 = 0.75;
/// Range of the length of a visible finger \[half-widths\].
const LENGTHS: (f64, f64) = (4.6, 12.0);
/// Length \[half-widths\] below which visible flanks do not determine the finger's length, and the
/// length that is then assumed.
const SEEN_LENGTH: f64 = 3.0;
const UNSEEN_LENGTH: f64 = 7.0;
/// Length of the flanks along which their strength and their surroundings are measured
/// \[half-widths\].
const FLANK_HALF_WIDTHS: f64 = 2.6;
/// Distance from the axis, or from the centre of the round end, at which the surroundings begin,
/// and spacing of the places there \[half-widths\]: the blur of the outline lies in between.
const SURROUNDINGS_FROM: f64 = 1.35;
const SURROUNDINGS_SPACING: f64 = 0.16;
/// Likeness of a band without contrast to its surroundings, and its increase with the least and
/// with the mean contrast of the three sides. The least weighs more: an edge or a stripe has
/// contrast on some sides, a finger on all.
const LIKENESS_WITHOUT_CONTRAST: f64 = 0.3;
const LEAST_CONTRAST_WEIGHT: f64 = 0.4;
const MEAN_CONTRAST_WEIGHT: f64 = 0.3;
/// Loss of score of a candidate without a hand behind it, and the part of the places there that
/// must be like the finger for no loss.
const HAND_WEIGHT: f64 = 0.3;
const HAND_PART: f64 = 0.5;

/// A frame in the coordinates of a band: along its axis and across it, in px from its tip.
#[derive(Debug, Clone, Copy)]
pub(super) struct BandFrame<'a> {
    frame: &'a Frame<'a>,
    tip: Point2<f64>,
    e: Vector2<f64>,
    n: Vector2<f64>,
    /// Whether its pixels are chromaticities.
    is_chromatic: bool,
}

impl<'a> BandFrame<'a> {
    pub(super) fn new(frame: &'a Frame<'a>, tip: Point2<f64>, angle_rad: f64) -> Self {
        let e = direction(angle_rad);
        Self { frame, tip, e, n: Vector2::new(-e.y, e.x), is_chromatic: false }
    }

    /// The same for chromaticities; `None` without colours.
    fn of_chromaticity(&self) -> Option<Self> {
        self.frame.colour().map(|_| Self { is_chromatic: true, ..*self })
    }

    fn place(&self, along_px: f64, across_px: f64) -> Point2<f64> {
        self.tip + self.e * along_px + self.n * across_px
    }

    /// Column and row of the pixel nearest to a place; `None` outside the image.
    #[inline]
    fn nearest(&self, along_px: f64, across_px: f64) -> Option<(usize, usize)> {
        let at = self.place(along_px, across_px);
        // By way of `i32`, to which a float converts in a single instruction.
        let whole = |x: f64| (x + 0.5) as i32 as usize;
        self.frame.image().contains(at.x, at.y, -0.5).then(|| (whole(at.x), whole(at.y)))
    }

    /// Colour of the pixel nearest to a place; without colours, the grey level repeated three
    /// times.
    #[inline]
    fn pixel(&self, along_px: f64, across_px: f64) -> Option<Vector3<f64>> {
        let (x, y) = self.nearest(along_px, across_px)?;
        match self.frame.colour() {
            Some(colour) => colour.pixel(x, y).map(|p| {
                if self.is_chromatic { chromaticity(p) } else { Vector3::from(p.map(f64::from)) }
            }),
            None => self.frame.image().pixel(x, y).map(|g| Vector3::repeat(f64::from(g))),
        }
    }

    /// Mean colour of the pixels nearest to some places; `None` if one lies outside the image.
    #[inline]
    fn mean(&self, places: impl ExactSizeIterator<Item = (f64, f64)>) -> Option<Vector3<f64>> {
        let (count, mut sum) = (places.len() as f64, [0_u32; 3]);
        let image = self.frame.image();
        for (along_px, across_px) in places {
            let (x, y) = self.nearest(along_px, across_px)?;
            let levels = match self.frame.colour() {
                Some(colour) => colour.pixel(x, y)?,
                None => [image.pixel(x, y)?; 3],
            };
            for (sum, level) in sum.iter_mut().zip(levels) {
                *sum += u32::from(level);
            }
        }
        Some(Vector3::from(sum.map(f64::from)) / count)
    }

    /// Offset of the strongest change of the mean colour in `from ..= to` px, and its strength
    /// \[grey levels\]. `at(offset, k)` is the place of sample k of the mean at an offset.
    fn strongest_change(
        &self,
        (from, to): (f64, f64),
        samples: usize,
        at: impl Fn(f64, usize) -> (f64, f64),
    ) -> Option<(f64, f64)> {
        let mean = |offset: f64| self.mean((0..samples).map(|k| at(offset, k)));
        let steps = (to - from).abs().ceil().max(1.0) as usize;
        let offset = |i: usize| from + (to - from) * i as f64 / steps as f64;
        let step = (to - from) / steps as f64;
        let mut best = None;
        let (mut before, mut here) = (mean(from - step)?, mean(from)?);
        for i in 0..=steps {
            let after = mean(offset(i) + step)?;
            let strength = (after - before).amax();
            if best.is_none_or(|(_, s)| strength > s) {
                best = Some((offset(i), strength));
            }
            (before, here) = (here, after);
        }
        best
    }
}

/// Colour distribution of the inside of a finger.
pub(super) struct Inside {
    mean: Vector3<f64>,
    information: Matrix3<f64>,
    unlike: f64,
}

impl Inside {
    /// Colours of a band's core between two distances across it, in parts of the core's half-width;
    /// `None` if too little of it lies in the image.
    pub(super) fn of(
        band_frame: &BandFrame<'_>,
        half_width_px: f64,
        (from, to): (f64, f64),
    ) -> Option<Self> {
        const ALONG: usize = 16;
        const PLACES: usize = 5;
        let (mut count, mut sum, mut squares) = (0.0, Vector3::zeros(), Matrix3::zeros());
        for i in 0..ALONG {
            let along = -half_width_px * (0.6 + 3.0 * i as f64 / (ALONG - 1) as f64);
            for j in 0..PLACES {
                let part = from + (to - from) * j as f64 / (PLACES - 1) as f64;
                let across = half_width_px * CORE_HALF_WIDTH_PART * part;
                if let Some(colour) = band_frame.pixel(along, across) {
                    count += 1.0;
                    sum += colour;
                    squares += colour * colour.transpose();
                }
            }
        }
        if count < 0.7 * (ALONG * PLACES) as f64 {
            return None;
        }
        let mean = sum / count;
        let floor = Matrix3::identity() * (COLOUR_FLOOR * COLOUR_FLOOR);
        let coloured = band_frame.frame.colour().is_some();
        let covariance = squares / count - mean * mean.transpose();
        if coloured {
            let information = (covariance + floor).try_inverse()?;
            return Some(Self { mean, information, unlike: UNLIKE_COLOUR });
        }
        let information = Matrix3::from_diagonal(&Vector3::new(
            1.0 / (covariance[(0, 0)].max(0.0) + COLOUR_FLOOR * COLOUR_FLOOR),
            0.0,
            0.0,
        ));
        Some(Self { mean, information, unlike: UNLIKE_GREY })
    }

    fn is_unlike(&self, colour: &Vector3<f64>) -> bool {
        let d = colour - self.mean;
        d.dot(&(self.information * d)) > self.unlike
    }

    /// Part of some places with another colour; `None` if most lie outside the image.
    fn unlike_part(
        &self,
        band_frame: &BandFrame<'_>,
        places: impl Iterator<Item = (f64, f64)>,
    ) -> Option<f64> {
        let (mut all, mut inside_count, mut unlike) = (0.0, 0.0, 0.0);
        for (along, across) in places {
            all += 1.0;
            if let Some(colour) = band_frame.pixel(along, across) {
                inside_count += 1.0;
                unlike += f64::from(u8::from(self.is_unlike(&colour)));
            }
        }
        (inside_count > 0.5 * all).then(|| unlike / inside_count)
    }
}

/// Refines the pose of a band, and measures the contrast of its inside with its surroundings.
pub(super) fn refine_candidate(
    frame: &Frame<'_>,
    map: &ForegroundMap,
    band: &Band,
) -> Option<RefinedCandidate> {
    const ALONG: usize = 10;
    const ACROSS: usize = 5;
    let w = band.half_width_px;
    let middle = band.tip - direction(band.angle_rad) * w;
    // First the flanks, at the angle of their greatest strength; then the end between them.
    let back = |k: usize| -w * (0.8 + FLANK_HALF_WIDTHS * k as f64 / (ALONG - 1) as f64);
    let mut best: Option<(f64, f64, BandFrame<'_>, [f64; 2])> = None;
    for turn_rad in TURNS_RAD {
        let angle_rad = band.angle_rad + turn_rad;
        let band_frame = BandFrame::new(frame, middle + direction(angle_rad) * w, angle_rad);
        let flank = |side: f64| {
            band_frame
                .strongest_change((0.6 * w, 1.5 * w), ALONG, |offset, k| (back(k), side * offset))
        };
        let weight = 1.0 - (turn_rad / TURN_REACH_RAD).powi(2);
        let exceeds = |strength: f64| best.as_ref().is_none_or(|(s, ..)| strength * weight > *s);
        let Some((left, l)) = flank(-1.0).filter(|&(_, l)| exceeds(l)) else { continue };
        let Some((right, r)) = flank(1.0).filter(|&(_, r)| exceeds(r)) else { continue };
        best = Some((l.min(r) * weight, angle_rad, band_frame, [left, right]));
    }
    let (_, angle_rad, mut band_frame, [left, right]) = best?;
    let half_width_px = 0.5 * (left + right);
    band_frame.tip += band_frame.n * (0.5 * (right - left));
    let (end, _) = band_frame.strongest_change((-0.9 * w, 0.9 * w), ACROSS, |offset, k| {
        (offset, half_width_px * (0.2 * k as f64 - 0.4))
    })?;
    band_frame.tip += band_frame.e * end;

    let inside = Inside::of(&band_frame, half_width_px, WHOLE_CORE)?;
    let score = band.score * stands_out(&band_frame, &inside, half_width_px)?;
    let band = Band { tip: band_frame.tip, angle_rad, half_width_px, ..*band };
    let foreground = inside_foreground(map, band.tip, angle_rad, half_width_px);
    let length_px = visible_length(&band_frame, &inside, half_width_px);
    Some(RefinedCandidate { band, length_px, colour: inside.mean, foreground, score })
}

/// Contrast of a band's inside with its sides and the region ahead of it, and its likeness to the
/// region behind, 0–1.
pub(super) fn stands_out(band_frame: &BandFrame<'_>, inside: &Inside, w: f64) -> Option<f64> {
    let unlike = [
        inside.unlike_part(band_frame, beside(w, -1.0))?,
        inside.unlike_part(band_frame, beside(w, 1.0))?,
        inside.unlike_part(band_frame, ahead(w))?,
    ];
    Some(finger_before_hand(band_frame, inside, w, unlike))
}

/// The same for a band that is lit from one side: each side is compared with the adjacent half by
/// colour or by chromaticity, whichever has the greater contrast, and the region behind by
/// chromaticity. `None` if the band is not lit from one side.
pub(super) fn half_lit_stands_out(
    band_frame: &BandFrame<'_>,
    inside: &Inside,
    w: f64,
) -> Option<f64> {
    let chromatic = band_frame.of_chromaticity()?;
    let halves = [(-1.0, (-1.0, -HALF_CORE_FROM)), (1.0, (HALF_CORE_FROM, 1.0))];
    let [left, right] = halves.map(|(_, half)| Inside::of(band_frame, w, half));
    let (one, other) = (left.as_ref()?.mean.sum(), right.as_ref()?.mean.sum());
    if one.min(other) > HALF_LIT * one.max(other) {
        return None;
    }
    let [left, right] = halves.map(|(side, half)| {
        let unlike =
            |band_frame| Inside::of(band_frame, w, half)?.unlike_part(band_frame, beside(w, side));
        Some(unlike(band_frame)?.max(unlike(&chromatic)?))
    });
    let whole = Inside::of(&chromatic, w, WHOLE_CORE)?;
    let ahead =
        inside.unlike_part(band_frame, ahead(w))?.max(whole.unlike_part(&chromatic, ahead(w))?);
    Some(finger_before_hand(&chromatic, &whole, w, [left?, right?, ahead]))
}

/// Places beside a band's flank.
pub(super) fn beside(w: f64, side: f64) -> impl Iterator<Item = (f64, f64)> {
    (0..12).flat_map(move |i| {
        let along = -w * (1.0 + FLANK_HALF_WIDTHS * f64::from(i) / 11.0);
        (0..4).map(move |j| {
            (along, side * w * (SURROUNDINGS_FROM + SURROUNDINGS_SPACING * f64::from(j)))
        })
    })
}

/// Places ahead of its tip.
pub(super) fn ahead(w: f64) -> impl Iterator<Item = (f64, f64)> {
    (0..9).flat_map(move |i| {
        let (sin, cos) = (1.05 * (f64::from(i) / 4.0 - 1.0)).sin_cos();
        (0..4).map(move |j| {
            let r = w * (SURROUNDINGS_FROM + SURROUNDINGS_SPACING * f64::from(j));
            (r * cos - w, r * sin)
        })
    })
}

/// Likeness of a band to a finger, 0–1: `unlike` are the parts with another colour on its left, on
/// its right and ahead. Behind a finger is a hand.
pub(super) fn finger_before_hand(
    band_frame: &BandFrame<'_>,
    inside: &Inside,
    w: f64,
    unlike: [f64; 3],
) -> f64 {
    let least = unlike.iter().copied().fold(1.0, f64::min);
    let mean = unlike.iter().sum::<f64>() / 3.0;
    let behind = 1.0 - inside.unlike_part(band_frame, hand_places(w)).unwrap_or(1.0);
    let hand = 1.0 - HAND_WEIGHT * (1.0 - behind / HAND_PART).max(0.0);
    (LIKENESS_WITHOUT_CONTRAST + LEAST_CONTRAST_WEIGHT * least + MEAN_CONTRAST_WEIGHT * mean) * hand
}

/// Places of the hand behind its finger.
pub(super) fn hand_places(w: f64) -> impl Iterator<Item = (f64, f64)> {
    (0..8).flat_map(move |i| {
        let along = -w * (5.0 + 5.0 * f64::from(i) / 7.0);
        (0..7).map(move |j| (along, w * (2.5 * (f64::from(j) / 3.0 - 1.0))))
    })
}

/// Length over which both flanks have contrast, limited to the range of a finger's length; a middle
/// length if the colours have no contrast even beside the tip.
pub(super) fn visible_length(band_frame: &BandFrame<'_>, inside: &Inside, w: f64) -> f64 {
    let has_contrast = |along: f64, side: f64| {
        (0..3).any(|j| {
            let across = side * w * (1.3 + 0.2 * f64::from(j));
            band_frame.pixel(along, across).is_some_and(|c| inside.is_unlike(&c))
        })
    };
    let (mut visible, mut back, mut misses) = (0.0, 1.0, 0);
    while back <= LENGTHS.1 && misses < 2 {
        if has_contrast(-back * w, -1.0) && has_contrast(-back * w, 1.0) {
            (visible, misses) = (back, 0);
        } else {
            misses += 1;
        }
        back += 0.5;
    }
    w * if visible < SEEN_LENGTH { UNSEEN_LENGTH } else { visible.clamp(LENGTHS.0, LENGTHS.1) }
}

/// Mean foreground probability along the axis of a band.
pub(super) fn inside_foreground(
    map: &ForegroundMap,
    tip: Point2<f64>,
    angle_rad: f64,
    half_width_px: f64,
) -> f64 {
    const SAMPLES: usize = 6;
    if map.cells.is_empty() {
        return 0.0;
    }
    let along = direction(angle_rad) * half_width_px;
    let at = |k: usize| tip - along * (0.7 + 0.5 * k as f64);
    (0..SAMPLES).map(|k| map.at(at(k).x, at(k).y)).sum::<f64>() / SAMPLES as f64
}

/// The unit vector at an angle.
pub(super) fn direction(angle_rad: f64) -> Vector2<f64> {
    Vector2::new(angle_rad.cos(), angle_rad.sin())
}
