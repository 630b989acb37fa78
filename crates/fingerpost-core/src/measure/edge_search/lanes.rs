//! Search lines in lanes: lane j of every vector belongs to line j.
//!
//! All arithmetic is integer, so every instruction set and every number of lanes gives the same
//! bits. Coordinates are 16.16 fixed point. Pixels are interpolated with 8 bits across and 7 bits
//! down, to 1/128 grey level; the kernel's response has the same unit. On a uniform image every
//! step is exact, and reversing a line negates its responses exactly.
//!
//! The work is divided into passes over all samples of the lines, because values stored one by one
//! cannot be reloaded as a vector immediately.

#![expect(
    clippy::inline_always,
    clippy::needless_bitwise_bool,
    reason = "what is inlined into a function with wider instructions is compiled for them, and a \
              vector has no branches"
)]

use crate::appearance::histogram::{BinnedPixels, LOG_RATIO_UNIT, LogRatio, LogRatioImage};
use crate::image::gray::GrayView;
use crate::measure::edge::{Miss, Polarity};
use crate::numeric::logarithm::ln;
use crate::numeric::simd::{Layout, Places, each};

/// The unit of responses and samples is a grey level over this.
pub(super) const ANSWER_UNIT: f64 = 128.0;
/// One pixel in fixed point, as a power of two.
const PIXEL_BITS: u32 = 16;
/// Half a step of the interpolation across and down: rounds a coordinate to its nearest step.
const HALF_STEP: [i32; 2] = [1 << 7, 1 << 8];
/// Half a pixel: rounds a coordinate to the nearest pixel.
const HALF_PIXEL: [i32; 2] = [1 << 15; 2];
/// From these fractions on, rounded to a step of the interpolation, the next pixel is the nearest.
const BEYOND_HALF: [u16; 2] = [(1 << 15) + HALF_STEP[0] as u16, (1 << 15) + HALF_STEP[1] as u16];
/// Maximum side of an image for 16.16 coordinates \[px\].
pub(super) const MAX_SIDE_PX: usize = i16::MAX as usize;
/// Maximum length of a row, so that every byte's address fits 32 bits.
pub(super) const MAX_STRIDE: usize = (1 << 17) - 1;

/// Origins and directions of lines, axis by axis \[px\].
#[derive(Debug, Clone, Copy)]
pub(super) struct Starts<const N: usize> {
    pub positions: [[f64; N]; 2],
    pub normals: [[f64; N]; 2],
}

impl<const N: usize> Default for Starts<N> {
    fn default() -> Self {
        Self { positions: [[0.0; N]; 2], normals: [[0.0; N]; 2] }
    }
}

/// Rounds to 2⁻¹⁶ px. (The bit pattern of 1.5 · 2³⁶ + x ends in x with 16 binary places.)
#[inline(always)]
fn fixed(x: f64) -> i32 {
    const SHIFT: f64 = (3_u64 << 35) as f64;
    (x + SHIFT).to_bits() as i32
}

/// The edge kernel.
#[derive(Debug, Clone, Copy)]
pub(super) struct LaneKernel<'a> {
    /// Weights at +1, +2, … px, times 2¹⁶.
    pub weights: &'a [u16],
    /// Minimum response, positive \[1/128 grey level\].
    pub least: i16,
    pub polarity: Polarity,
}

/// Minimum separation of the hand's edge, and the score of a response e times as strong.
#[derive(Debug, Clone, Copy)]
pub(super) struct Scoring {
    pub min_separation: f32,
    pub strength_weight: f32,
}

/// The best peak of a line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Peak {
    /// Index of the response, at least 1.
    pub at: usize,
    /// The responses before it, at it and after it \[1/128 grey level\].
    pub answers: [i16; 3],
}

/// `N` lines of equally many samples, and the buffers to search them.
#[derive(Debug, Clone)]
pub(super) struct SearchLanes<const N: usize> {
    start: [[i32; N]; 2],
    step: [[i32; N]; 2],
    /// All bits set if all samples of a line are inside the image, none otherwise.
    inside: [i32; N],
    /// Addresses of the bytes of every sample.
    places: Places<N>,
    /// Histogram bins of the pixels nearest to the samples of a grey image.
    bins: Vec<[u8; N]>,
    /// The kernel's weights, repeated in every lane.
    weights: Vec<[u16; N]>,
    /// Grey levels at the samples, in 1/128.
    grey: Vec<[u16; N]>,
    /// The kernel's responses, from the first offset at which it fits.
    answers: Vec<[i16; N]>,
    /// Log-likelihood ratios summed from the inner end up to each sample.
    log_ratios: Vec<[i32; N]>,
    peaks: [i16; N],
}

/// No peak was found.
const NONE: i16 = 0;

impl<const N: usize> SearchLanes<N> {
    /// Lines of up to `samples` samples.
    pub fn with_capacity(samples: usize) -> Self {
        Self {
            start: [[0; N]; 2],
            step: [[0; N]; 2],
            inside: [0; N],
            places: Places::with_capacity(samples),
            bins: Vec::with_capacity(samples),
            weights: Vec::with_capacity(samples),
            grey: Vec::with_capacity(samples),
            answers: Vec::with_capacity(samples),
            log_ratios: Vec::with_capacity(samples + 1),
            peaks: [NONE; N],
        }
    }

    /// Sets `count` lines of `samples` samples, from the offset `from`, in an image of `size`. A
    /// line that leaves the image stays at its first pixel, as do unused lanes.
    #[inline(always)]
    pub fn set(
        &mut self,
        starts: &Starts<N>,
        count: usize,
        from: i32,
        samples: usize,
        size: [usize; 2],
    ) {
        let steps = samples as i32 - 1;
        let (first, last) = (f64::from(from), f64::from(from + steps));
        let mut inside: [i32; N] = each(|j| -i32::from(j < count));
        for (axis, &side) in size.iter().enumerate() {
            let (position, normal) = (&starts.positions[axis], &starts.normals[axis]);
            let side = side as i32 - 1;
            // Half a step of the interpolation is added later; a start within a step of the far
            // side is moved inside.
            let limit = (side << PIXEL_BITS) - 2 * HALF_STEP[1];
            let side = f64::from(side);
            let near: [f64; N] = each(|j| position[j] + normal[j] * first);
            let far: [f64; N] = each(|j| position[j] + normal[j] * last);
            self.start[axis] = each(|j| fixed(near[j]).clamp(0, limit.max(0)));
            self.step[axis] = each(|j| fixed(normal[j]));
            // An image is convex: a line with both ends inside is inside. Such an end does not
            // overflow, but rounding may have put it outside.
            let ends_inside: [i64; N] =
                each(|j| -i64::from((near[j].min(far[j]) >= 0.0) & (near[j].max(far[j]) <= side)));
            inside = each(|j| {
                let end = self.step[axis][j].wrapping_mul(steps).wrapping_add(self.start[axis][j]);
                inside[j] & ends_inside[j] as i32 & -i32::from((0 <= end) & (end <= limit))
            });
        }
        for axis in 0..2 {
            self.start[axis] = each(|j| self.start[axis][j] & inside[j]);
            self.step[axis] = each(|j| self.step[axis][j] & inside[j]);
        }
        self.inside = inside;
        self.bins.resize(samples, [0; N]);
        self.grey.resize(samples, [0; N]);
        self.log_ratios.resize(samples + 1, [0; N]);
    }

    /// Whether line `j` was searched: all its samples are inside the image.
    #[inline]
    pub fn is_inside(&self, j: usize) -> bool {
        self.inside[j] != 0
    }

    /// Finds the best peak of every line.
    #[inline(always)]
    pub fn find_edges(
        &mut self,
        image: &GrayView<'_>,
        kernel: &LaneKernel<'_>,
        log_ratio_image: Option<(&LogRatioImage<'_>, &Scoring)>,
    ) {
        self.locate(image.stride(), 1, HALF_STEP);
        if let Some((LogRatioImage { pixels: BinnedPixels::Gray(..), log_ratios }, _)) =
            log_ratio_image
        {
            self.interpolate::<true>(image);
            add_up(&mut self.log_ratios, &self.bins, |bin| log_ratios[usize::from(bin)]);
        } else {
            self.interpolate::<false>(image);
            if let Some((log_ratio_image, _)) = log_ratio_image {
                self.sum_log_ratios(log_ratio_image);
            }
        }
        self.correlate(kernel.weights);
        let scoring = log_ratio_image.map(|(_, scoring)| scoring);
        match kernel.polarity {
            Polarity::Bright => self.choose(kernel, scoring, |r| r),
            Polarity::Dark => self.choose(kernel, scoring, |r| -r),
            Polarity::Unknown => self.choose(kernel, scoring, |r| if r < 0 { -r } else { r }),
        }
    }

    /// Sums the log-likelihood ratios along every line.
    #[inline(always)]
    pub fn sum_log_ratios(&mut self, log_ratio_image: &LogRatioImage<'_>) {
        match log_ratio_image.pixels {
            BinnedPixels::Gray(bytes, stride) => {
                self.locate(stride, 1, HALF_PIXEL);
                self.places.read_words(bytes);
                self.sum_up(log_ratio_image.log_ratios, |word| (word & 0xff) >> 2);
            }
            BinnedPixels::Colour(bytes, stride) => {
                self.locate(stride, 3, HALF_PIXEL);
                self.places.read_words(bytes);
                // The upper halves of three bytes, the first in front.
                self.sum_up(log_ratio_image.log_ratios, |word| {
                    ((word & 0xf0) << 4) | ((word >> 8) & 0xf0) | ((word >> 20) & 0xf)
                });
            }
            BinnedPixels::Nobody => self.log_ratios.fill([0; N]),
        }
    }

    /// The peak of line `j`, or the reason for its absence.
    #[inline]
    pub fn peak(&self, j: usize, kernel: &LaneKernel<'_>) -> Result<Peak, Miss> {
        let at = usize::from(self.peaks[j] as u16);
        let about = at.checked_sub(1).and_then(|before| self.answers.get(before..)?.first_chunk());
        about.map(|about: &[_; 3]| Peak { at, answers: each(|i| about[i][j]) }).ok_or_else(|| {
            if self.rises_to_end(j, kernel) { Miss::BeyondEnd } else { Miss::NoContrast }
        })
    }

    /// Whether the response of line `j`, in the sense of the polarity, increases up to one of its
    /// ends.
    fn rises_to_end(&self, j: usize, kernel: &LaneKernel<'_>) -> bool {
        let n = self.answers.len();
        let [first, second, before_last, last] = [0, 1, n - 2, n - 1].map(|i| {
            let answer = self.answers[i][j];
            match kernel.polarity {
                Polarity::Bright => answer,
                Polarity::Dark => -answer,
                Polarity::Unknown => answer.abs(),
            }
        });
        (first >= kernel.least && first > second) || (last >= kernel.least && last >= before_last)
    }

    /// Mean log-likelihood ratio of the pixels inside the peak at `at` of line `j` minus that of
    /// those outside, over the kernel's window; the edge's own pixel belongs to neither side.
    #[inline]
    pub fn separation(&self, j: usize, at: usize, reach: usize) -> f32 {
        let inside = self.log_ratios[at + reach][j] - self.log_ratios[at][j];
        let outside = self.log_ratios[at + 2 * reach + 1][j] - self.log_ratios[at + reach + 1][j];
        (inside - outside) as f32 / (reach as f32 * LOG_RATIO_UNIT)
    }

    /// The maximum of the summed log-likelihood ratio of line `j`: the index of the sample after
    /// it, and the difference of the means over the `reach` samples on either side. `BeyondEnd`
    /// with fewer samples.
    #[inline]
    pub fn log_ratio_change(&self, j: usize, reach: usize) -> Result<(usize, f32), Miss> {
        let (mut best, mut at) = (i32::MIN, 0);
        for (i, sum) in self.log_ratios.iter().enumerate() {
            if sum[j] > best {
                (best, at) = (sum[j], i);
            }
        }
        if at < reach || at + reach >= self.log_ratios.len() {
            return Err(Miss::BeyondEnd);
        }
        let around: [_; 3] = each(|i| self.log_ratios[at + i * reach - reach][j]);
        let difference = (2 * around[1] - around[0] - around[2]) as f32;
        Ok((at, difference / (reach as f32 * LOG_RATIO_UNIT)))
    }

    /// Computes the addresses of all samples, rounded by `half`, of `pitch` bytes each.
    #[inline(always)]
    fn locate(&mut self, stride: usize, pitch: usize, half: [i32; 2]) {
        let start = |axis: usize| -> [i32; N] { each(|j| self.start[axis][j] + half[axis]) };
        let layout = Layout { stride: stride as u32, pitch: pitch as u32 };
        self.places.locate([start(0), start(1)], self.step, self.grey.len(), layout);
    }

    /// Interpolates grey levels at all samples and, if `LOG_RATIO`, takes the bins of the nearest
    /// pixels.
    #[inline(always)]
    fn interpolate<const LOG_RATIO: bool>(&mut self, image: &GrayView<'_>) {
        let Self { places, start, step, grey, bins, .. } = self;
        let (bytes, stride) = (image.data(), image.stride());
        if let Some(cells) = places.wide_cells(bytes, stride) {
            blend::<_, LOG_RATIO>(grey, bins, cells, *start, *step);
        } else if let Some(cells) = places.cells(bytes, stride) {
            blend::<_, LOG_RATIO>(grey, bins, cells, *start, *step);
        } else {
            // Without a grey level there is no edge, and no log-likelihood ratio is read.
            grey.fill([0; N]);
        }
    }

    /// Response at every offset where the kernel fits: inside minus outside, weighted by the
    /// kernel.
    #[inline(always)]
    fn correlate(&mut self, weights: &[u16]) {
        self.answers.resize(self.grey.len() - 2 * weights.len(), [0; N]);
        // Repeated in memory: the compiler multiplies 16-bit numbers in vectors only if both are
        // vectors.
        self.weights.clear();
        self.weights.extend(weights.iter().map(|&w| [w; N]));
        let (several, rest) = self.answers.as_chunks_mut::<ANSWERS>();
        let ahead = ANSWERS * several.len();
        for (i, answers) in several.iter_mut().enumerate() {
            *answers = correlated(&self.weights, &self.grey[ANSWERS * i..]);
        }
        for (i, answer) in rest.iter_mut().enumerate() {
            [*answer] = correlated(&self.weights, &self.grey[ahead + i..]);
        }
    }

    /// Selects among the peaks of the given polarity: the strongest one, or with an appearance
    /// model the one of the best score.
    #[inline(always)]
    fn choose(
        &mut self,
        kernel: &LaneKernel<'_>,
        scoring: Option<&Scoring>,
        strength: impl Fn(i16) -> i16 + Copy,
    ) {
        if let Some(scoring) = scoring {
            self.best_separated(kernel, *scoring, strength);
        } else {
            self.strongest(kernel.least, strength);
        }
    }

    #[inline(always)]
    fn strongest(&mut self, least: i16, strength: impl Fn(i16) -> i16 + Copy) {
        let (mut best, mut at) = ([least - 1; N], [NONE; N]);
        let all = |answers: &[i16; N]| -> [i16; N] { each(|j| strength(answers[j])) };
        let [first, second, others @ ..] = self.answers.as_slice() else { return };
        let (mut before, mut here) = (all(first), all(second));
        for (i, after) in (1_i16..).zip(others) {
            let after = all(after);
            // Not less than before, more than after and more than the best to date.
            let beaten: [_; N] = each(|j| (before[j] - 1).max(after[j]).max(best[j]));
            at = each(|j| if here[j] > beaten[j] { i } else { at[j] });
            best = each(|j| if here[j] > beaten[j] { here[j] } else { best[j] });
            (before, here) = (here, after);
        }
        self.peaks = at;
    }

    #[inline(always)]
    fn best_separated(
        &mut self,
        kernel: &LaneKernel<'_>,
        scoring: Scoring,
        strength: impl Fn(i16) -> i16 + Copy,
    ) {
        let Scoring { min_separation, strength_weight } = scoring;
        let reach = kernel.weights.len();
        let unit = 1.0 / (reach as f32 * LOG_RATIO_UNIT);
        let (mut best, mut at) = ([f32::NEG_INFINITY; N], [i32::from(NONE); N]);
        let sums = self.log_ratios[1..].windows(2 * reach + 2);
        for (i, (three, sums)) in (1_i32..).zip(self.answers.windows(3).zip(sums)) {
            let all = |answers: &[i16; N]| -> [i16; N] { each(|j| strength(answers[j])) };
            let (before, here, after) = (all(&three[0]), all(&three[1]), all(&three[2]));
            // All bits set at a peak, in lanes as wide as the responses, so that they are compared
            // together.
            let peaks: [i16; N] = each(|j| {
                -i16::from(
                    (here[j] >= before[j]) & (here[j] > after[j]) & (here[j] >= kernel.least),
                )
            });
            // Peaks are few, and those of neighbouring lines have similar positions.
            if peaks == [0; N] {
                continue;
            }
            let [a, b, c, d] = [0, reach, reach + 1, 2 * reach + 1].map(|k| &sums[k]);
            for j in 0..N {
                let separation = (b[j] - a[j] - d[j] + c[j]) as f32 * unit;
                let score = separation + strength_weight * ln(f32::from(here[j].max(1)));
                let better = (peaks[j] != 0) & (separation >= min_separation) & (score > best[j]);
                best[j] = if better { score } else { best[j] };
                at[j] = if better { i } else { at[j] };
            }
        }
        self.peaks = each(|j| at[j] as i16);
    }

    /// Sums the log-likelihood ratios of all samples, with the bin that `bin` computes from a
    /// sample's bytes.
    #[inline(always)]
    fn sum_up(&mut self, log_ratios: &LogRatio, bin: impl Fn(u32) -> u32) {
        let words = self.places.words_mut();
        for words in &mut *words {
            *words = each(|j| bin(words[j]));
        }
        add_up(&mut self.log_ratios, words, |bin| log_ratios[bin as usize % log_ratios.len()]);
    }
}

/// Cumulative sums of the log-likelihood ratios of bins; the first entry is zero.
#[inline(always)]
fn add_up<B: Copy, const N: usize>(
    sums: &mut [[i32; N]],
    bins: &[[B; N]],
    log_ratio_at: impl Fn(B) -> i16,
) {
    let mut sum = [0; N];
    let [nothing, sums @ ..] = sums else { return };
    *nothing = sum;
    for (total, bins) in sums.iter_mut().zip(bins) {
        let log_ratios: [i16; N] = each(|j| log_ratio_at(bins[j]));
        sum = each(|j| sum[j] + i32::from(log_ratios[j]));
        *total = sum;
    }
}

/// Bilinear grey levels of samples from `start` on, `step` apart; if `LOG_RATIO`, also the bins of
/// the nearest pixels.
#[inline(always)]
fn blend<const N: usize, const LOG_RATIO: bool>(
    grey: &mut [[u16; N]],
    bins: &mut [[u8; N]],
    cells: impl Iterator<Item = [[u16; N]; 2]>,
    start: [[i32; N]; 2],
    step: [[i32; N]; 2],
) {
    // Fractions of a pixel are the lower halves of the coordinates.
    let fraction = |axis: usize| -> ([u16; N], [u16; N]) {
        let start = each(|j| (start[axis][j] + HALF_STEP[axis]) as u16);
        (start, each(|j| step[axis][j] as u16))
    };
    let ((mut x, dx), (mut y, dy)) = (fraction(0), fraction(1));
    for ((grey, bins), [above, below]) in grey.iter_mut().zip(bins).zip(cells) {
        *grey = each(|j| {
            let (right, lower) = (x[j] >> 8, y[j] >> 9);
            let row = |pair: u16| (pair & 255) * (256 - right) + (pair >> 8) * right;
            high(row(above[j]), (128 - lower) << 8) + high(row(below[j]), lower << 8)
        });
        if LOG_RATIO {
            *bins = each(|j| {
                let row = if y[j] < BEYOND_HALF[1] { above[j] } else { below[j] };
                let pixel = if x[j] < BEYOND_HALF[0] { row & 255 } else { row >> 8 };
                (pixel >> 2) as u8
            });
        }
        x = each(|j| x[j].wrapping_add(dx[j]));
        y = each(|j| y[j].wrapping_add(dy[j]));
    }
}

/// Number of responses computed together: their sums fit the registers.
const ANSWERS: usize = 4;

/// The responses of a kernel to the samples from its first offset on.
#[inline(always)]
fn correlated<const N: usize, const M: usize>(
    weights: &[[u16; N]],
    samples: &[[u16; N]],
) -> [[i16; N]; M] {
    let mut answers = [[0_i16; N]; M];
    let reach = weights.len();
    for (k, weight) in (1..).zip(weights) {
        let (inside, outside) = (&samples[reach - k..][..M], &samples[reach + k..][..M]);
        for i in 0..M {
            let (plus, minus) = (scaled(&inside[i], weight), scaled(&outside[i], weight));
            answers[i] =
                each(|j| answers[i][j].wrapping_add(plus[j].wrapping_sub(minus[j]) as i16));
        }
    }
    answers
}

/// Every number times its weight, in 2⁻¹⁶.
#[inline(always)]
fn scaled<const N: usize>(numbers: &[u16; N], weights: &[u16; N]) -> [u16; N] {
    each(|j| high(numbers[j], weights[j]))
}

/// The upper half of a product.
#[inline(always)]
fn high(a: u16, b: u16) -> u16 {
    ((u32::from(a) * u32::from(b)) >> 16) as u16
}
