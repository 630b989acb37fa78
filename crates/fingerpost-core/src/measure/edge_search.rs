//! Edge search along the normals of a contour.
//!
//! Every search line samples the image at whole pixels along an outward normal and correlates the
//! profile with the derivative of a Gaussian. The offset is the peak of the response, to a fraction
//! of a pixel. With kernel scale s, edge blur σ_b, S² = s² + σ_b², contrast A and white noise σ_n
//! the offset of the peak has the variance
//!
//! ```text
//! Var(offset) = (3 √π / 4) · σ_n² S⁶ / (A² s⁵)        [px²]
//! ```
//!
//! per independent pixel of contour: the noise of the response's slope, ∫ g″² · σ_n², over the
//! squared curvature of the blurred step's response at its peak.
//!
//! Source: Canny 1986 for the operator; Cipolla & Blake 1992 for the search along normals.

mod lanes;

use super::edge::{Edge, EdgeMeasurement, MAX_HALF_LENGTH_PX, Miss, Polarity, Scale, SearchLine};
use crate::appearance::histogram::{HistogramModel, LogRatioImage};
use crate::geometry::shape_space::PlacedSample;
use crate::image::frame::{ColourView, Frame};
use crate::image::gray::GrayView;
use crate::numeric::simd::{BASELINE_LANES, Isa, Work};
use crate::{Error, Result};
use lanes::{Peak, Scoring, SearchLanes, Starts};
use nalgebra::Vector2;
use std::f64::consts::PI;

/// Options of the edge search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SearchOptions {
    /// Scale s of the derivative of Gaussian \[px\], 0.5–8.
    pub scale_px: f64,
    /// Blur σ_b of the edges in the image \[px\], 0–8; only contrast and variance depend on it.
    pub blur_px: f64,
    /// Standard deviation σ_n of the image noise \[grey levels\], 0.1–64.
    pub noise_grey: f64,
    /// Minimum contrast of an edge \[grey levels\], 0–255.
    pub min_contrast_grey: f64,
}

impl Default for SearchOptions {
    fn default() -> Self {
        Self { scale_px: 1.6, blur_px: 1.0, noise_grey: 2.0, min_contrast_grey: 8.0 }
    }
}

/// The edge cue: which place on a search line is measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Cue<'a> {
    /// The strongest edge.
    Edges,
    /// The edge that best separates the hand from its background.
    HandEdges(&'a HistogramModel),
    /// The place where the log-likelihood ratio of the pixels changes sign, with or without an
    /// edge. It is coarse, but independent of distance and motion blur.
    LogRatio(&'a HistogramModel),
}

impl<'a> Cue<'a> {
    /// The appearance model of the hand, if the cue has one.
    pub(crate) fn appearance(self) -> Option<&'a HistogramModel> {
        match self {
            Self::Edges => None,
            Self::HandEdges(appearance) | Self::LogRatio(appearance) => Some(appearance),
        }
    }
}

/// Margin of the samples from the image's border \[px\]: rounding the first coordinate and every
/// step to fixed point must not put a sample outside.
const BORDER_MARGIN_PX: f64 = 1.0 / 64.0;

/// A derivative of a Gaussian.
#[derive(Debug, Clone)]
struct Kernel {
    /// Weights at +1, +2, … px, up to 3 s, times 2¹⁶; the weight at −k is the negative, at 0 it is
    /// zero. They sum to one, so the response to a sharp step of contrast A is A.
    weights: Vec<u16>,
    /// Minimum response of an edge \[1/128 grey level\].
    least: i16,
    /// Contrast of a blurred step with a response of one unit.
    contrast_per_answer: f64,
    /// The variance of the offset (see the module) times the squared contrast, for unit noise.
    variance_at_one_grey: f64,
}

/// Scale of the coarse kernel over that of the fine one.
const COARSE: f64 = 2.5;
/// Number of lines searched together: 16-bit lanes of an AVX2 vector, and of a baseline vector.
const WIDE: usize = 2 * NARROW;
const NARROW: usize = BASELINE_LANES;

/// Reach of the widest of some kernels \[px\].
fn widest(kernels: &[Kernel]) -> usize {
    kernels.iter().map(Kernel::reach).max().unwrap_or(0)
}

/// The kernels and the reused buffers of a search: searching allocates nothing.
#[derive(Debug, Clone)]
pub struct EdgeSearch {
    kernels: [Kernel; 2],
    options: SearchOptions,
    isa: Isa,
    wide: SearchLanes<WIDE>,
    narrow: SearchLanes<NARROW>,
    alone: SearchLanes<1>,
}

impl EdgeSearch {
    /// A search with the given options.
    ///
    /// # Errors
    /// When an option is not finite or outside its documented range.
    pub fn new(options: SearchOptions) -> Result<Self> {
        let SearchOptions { scale_px, blur_px, noise_grey, min_contrast_grey } = options;
        Error::within("search scale [px]", scale_px, "0.5 to 8", |s| (0.5..=8.0).contains(&s))?;
        Error::within("edge blur [px]", blur_px, "0 to 8", |b| (0.0..=8.0).contains(&b))?;
        Error::within("image noise [grey levels]", noise_grey, "0.1 to 64", |n| {
            (0.1..=64.0).contains(&n)
        })?;
        Error::within("least contrast [grey levels]", min_contrast_grey, "0 to 255", |c| {
            (0.0..=255.0).contains(&c)
        })?;
        let kernels = [1.0, COARSE].map(|factor| Kernel::new(factor * scale_px, &options));
        let reach = widest(&kernels);
        let samples = 2 * (MAX_HALF_LENGTH_PX + reach) + 1;
        Ok(Self {
            kernels,
            options,
            isa: Isa::detect(),
            wide: SearchLanes::with_capacity(samples),
            narrow: SearchLanes::with_capacity(samples),
            alone: SearchLanes::with_capacity(samples),
        })
    }

    /// The same search with another instruction set than the processor's widest: slower, with
    /// bit-identical results.
    #[must_use]
    #[doc(hidden)]
    pub fn with_isa(self, isa: Isa) -> Self {
        Self { isa, ..self }
    }

    /// The options in force.
    #[must_use]
    pub fn options(&self) -> &SearchOptions {
        &self.options
    }

    /// Distance beyond the end of a line that its search reads at any scale \[px\].
    pub(crate) fn reach_px(&self) -> f64 {
        widest(&self.kernels) as f64
    }

    /// Searches every line for `cue`; `measurements` is refilled, one entry a line, in the same
    /// order.
    ///
    /// Lines of one length and polarity are searched together, if at most one other length lies
    /// between them. A line that leaves the image is searched alone, on its part inside, which
    /// takes several times as long. An image of one row or one column has no edges.
    ///
    /// # Errors
    /// When a line's half-length is not finite, not positive or above [`MAX_HALF_LENGTH_PX`], or
    /// its sample is not finite; when a side of the image exceeds 32 767 px or a row 131 071 bytes.
    pub fn search(
        &mut self,
        frame: &Frame<'_>,
        cue: Cue<'_>,
        scale: Scale,
        lines: &[SearchLine],
        measurements: &mut Vec<EdgeMeasurement>,
    ) -> Result<()> {
        let image = frame.image();
        check_size(frame)?;
        let Self { kernels, options, isa, wide, narrow, alone } = self;
        let kernel = &kernels[scale as usize];
        let log_ratio_image = cue.appearance().map(|appearance| appearance.log_ratio_image(frame));
        let by_log_ratio = matches!(cue, Cue::LogRatio(_));
        let variance_px2 = kernel.variance_at_one_grey * options.noise_grey.powi(2);
        let pass = Pass { kernel, variance_px2, isa: *isa, image, log_ratio_image, by_log_ratio };
        measurements.clear();
        measurements.resize(lines.len(), Err(Miss::OutOfImage));
        match isa {
            Isa::Avx2 => pass.measure_all(wide, lines, measurements)?,
            Isa::Baseline => pass.measure_all(narrow, lines, measurements)?,
            Isa::Scalar => pass.measure_all(alone, lines, measurements)?,
        }
        if measurements.contains(&Err(Miss::OutOfImage)) {
            pass.measure_visible(alone, lines, measurements)?;
        }
        Ok(())
    }
}

/// Refuses a frame too large for the search: coordinates are 16.16 fixed point, addresses 32 bits.
pub(crate) fn check_size(frame: &Frame<'_>) -> Result<()> {
    let image = frame.image();
    let (width, height) = (image.width(), image.height());
    if width.max(height) > lanes::MAX_SIDE_PX {
        return Err(Error::ImageTooLarge { width, height, limit: lanes::MAX_SIDE_PX });
    }
    let stride = frame.colour().map_or(0, ColourView::stride).max(image.stride());
    Error::within("row of the image [bytes]", stride as f64, "at most 131071", |s| {
        s <= lanes::MAX_STRIDE as f64
    })?;
    Ok(())
}

/// Whole pixels of a line on either side.
fn whole_half_length(half_length_px: f64) -> Result<i32> {
    Error::within("search half-length [px]", half_length_px, "positive and at most 128", |l| {
        l > 0.0 && l <= MAX_HALF_LENGTH_PX as f64
    })?;
    let whole = half_length_px as i32;
    Ok(whole + i32::from(f64::from(whole) < half_length_px))
}

/// Refuses a sample that is not finite.
fn check_sample(PlacedSample { position, normal }: &PlacedSample) -> Result<()> {
    if !(position.x + position.y + normal.x + normal.y).is_finite() {
        Error::finite("search position [px]", position.x + position.y)?;
        Error::finite("search normal", normal.x + normal.y)?;
    }
    Ok(())
}

/// First and last whole offset of a line's samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Span {
    from: i32,
    to: i32,
}

impl Span {
    fn samples(self) -> usize {
        (self.to - self.from + 1) as usize
    }

    /// Whether the kernel fits at offset zero and at three offsets or more.
    fn fits_kernel(self, reach: i32) -> bool {
        let (first, last) = (self.from + reach, self.to - reach);
        last - first >= 2 && first <= 0 && last >= 0
    }
}

/// Lines to be searched together.
#[derive(Debug, Clone, Copy)]
struct Batch<const N: usize> {
    /// The offsets of their samples and the polarity, common to all of them.
    key: (Span, Polarity),
    starts: Starts<N>,
    /// Indices of the lines.
    lines: [usize; N],
    count: usize,
}

impl<const N: usize> Batch<N> {
    fn of(key: (Span, Polarity)) -> Self {
        Self { key, starts: Starts::default(), lines: [0; N], count: 0 }
    }

    #[inline]
    fn push(&mut self, line: usize, sample: &PlacedSample) {
        let PlacedSample { position, normal } = sample;
        let j = self.count;
        for (axis, (p, n)) in
            [(position.x, normal.x), (position.y, normal.y)].into_iter().enumerate()
        {
            self.starts.positions[axis][j] = p;
            self.starts.normals[axis][j] = n;
        }
        self.lines[j] = line;
        self.count = j + 1;
    }
}

/// State common to all lines of one search.
struct Pass<'a> {
    kernel: &'a Kernel,
    /// Variance of the offset (see the module) times the squared contrast.
    variance_px2: f64,
    isa: Isa,
    image: &'a GrayView<'a>,
    log_ratio_image: Option<LogRatioImage<'a>>,
    by_log_ratio: bool,
}

impl Pass<'_> {
    /// Searches all lines in batches. The measurement of a line that leaves the image is
    /// `OutOfImage`.
    fn measure_all<const N: usize>(
        &self,
        lanes: &mut SearchLanes<N>,
        lines: &[SearchLine],
        measurements: &mut [EdgeMeasurement],
    ) -> Result<()> {
        let reach = self.kernel.reach() as i32;
        // Along a contour the lengths required by a motion often alternate between two.
        let [mut one, mut another] =
            [Batch::<N>::of((Span { from: 0, to: 0 }, Polarity::Unknown)); 2];
        let (mut open, mut other) = (&mut one, &mut another);
        let mut last = None;
        for (i, line) in lines.iter().enumerate() {
            // Most lines are as long as the one before.
            let requested = Some((line.half_length_px.to_bits(), line.polarity));
            if last != requested || open.count == N {
                last = requested;
                let half_span = whole_half_length(line.half_length_px)? + reach;
                let key = (Span { from: -half_span, to: half_span }, line.polarity);
                if open.key != key {
                    std::mem::swap(&mut open, &mut other);
                }
                if open.key != key || open.count == N {
                    self.measure(lanes, open, measurements);
                    (open.key, open.count) = (key, 0);
                }
            }
            check_sample(&line.sample)?;
            open.push(i, &line.sample);
        }
        self.measure(lanes, open, measurements);
        self.measure(lanes, other, measurements);
        Ok(())
    }

    /// Searches the lines that leave the image on their parts inside.
    fn measure_visible(
        &self,
        alone: &mut SearchLanes<1>,
        lines: &[SearchLine],
        measurements: &mut [EdgeMeasurement],
    ) -> Result<()> {
        let reach = self.kernel.reach() as i32;
        for (i, line) in lines.iter().enumerate() {
            if matches!(measurements[i], Err(Miss::OutOfImage)) {
                let half_span = whole_half_length(line.half_length_px)? + reach;
                if let Some(span) = visible_span(self.image, &line.sample, half_span)
                    .filter(|visible| visible.fits_kernel(reach))
                {
                    let mut batch = Batch::of((span, line.polarity));
                    batch.push(i, &line.sample);
                    self.measure(alone, &batch, measurements);
                }
            }
        }
        Ok(())
    }

    /// Searches the lines of a batch, if there are any, and stores their measurements.
    fn measure<const N: usize>(
        &self,
        lanes: &mut SearchLanes<N>,
        batch: &Batch<N>,
        measurements: &mut [EdgeMeasurement],
    ) {
        if batch.count > 0 {
            self.isa.run(Search { pass: self, lanes, batch });
            for (j, &line) in batch.lines[..batch.count].iter().enumerate() {
                measurements[line] = self.found(lanes, j, batch.key);
            }
        }
    }

    /// The measurement of line `j` by the last search; `OutOfImage` where the line leaves the
    /// image.
    #[inline]
    fn found<const N: usize>(
        &self,
        lanes: &SearchLanes<N>,
        j: usize,
        (span, polarity): (Span, Polarity),
    ) -> EdgeMeasurement {
        if !lanes.is_inside(j) {
            Err(Miss::OutOfImage)
        } else if self.by_log_ratio {
            self.log_ratio_change(lanes, j, span)
        } else {
            self.edge(lanes, j, span, polarity)
        }
    }

    #[inline]
    fn edge<const N: usize>(
        &self,
        lanes: &SearchLanes<N>,
        j: usize,
        span: Span,
        polarity: Polarity,
    ) -> EdgeMeasurement {
        let (kernel, reach) = (self.kernel, self.kernel.reach());
        let Peak { at, answers } = lanes.peak(j, &kernel.for_polarity(polarity))?;
        let contrast_grey = kernel.contrast(answers[1]);
        Ok(Edge {
            offset_px: f64::from(span.from + (reach + at) as i32) + parabola_peak(answers),
            contrast_grey,
            variance_px2: self.variance_px2 / (contrast_grey * contrast_grey),
            separation: self.log_ratio_image.map(|_| f64::from(lanes.separation(j, at, reach))),
        })
    }

    /// The maximum-likelihood position of the contour for independent pixels: the maximum of the
    /// log-likelihood ratio summed from the inner end.
    fn log_ratio_change<const N: usize>(
        &self,
        lanes: &SearchLanes<N>,
        j: usize,
        span: Span,
    ) -> EdgeMeasurement {
        let (at, separation) = lanes.log_ratio_change(j, self.kernel.reach())?;
        if separation < MIN_SEPARATION {
            return Err(Miss::NoContrast);
        }
        Ok(Edge {
            // The sum up to sample i ends half a pixel before that sample.
            offset_px: f64::from(span.from) + at as f64 - 0.5,
            contrast_grey: 0.0,
            variance_px2: LOG_RATIO_VARIANCE_PX2,
            separation: Some(f64::from(separation)),
        })
    }
}

/// The search of one batch, for any instruction set.
struct Search<'a, const N: usize> {
    pass: &'a Pass<'a>,
    lanes: &'a mut SearchLanes<N>,
    batch: &'a Batch<N>,
}

impl<const N: usize> Work for Search<'_, N> {
    #[expect(clippy::inline_always, reason = "so that it is compiled for every instruction set")]
    #[inline(always)]
    fn run(self) {
        let Self { pass: Pass { kernel, image, log_ratio_image, by_log_ratio, .. }, lanes, batch } =
            self;
        let Batch { key: (span, polarity), starts, count, .. } = batch;
        let size = [image.width(), image.height()];
        lanes.set(starts, *count, span.from, span.samples(), size);
        let log_ratio_image = log_ratio_image.as_ref();
        if let (true, Some(log_ratio_image)) = (*by_log_ratio, log_ratio_image) {
            lanes.sum_log_ratios(log_ratio_image);
            return;
        }
        let kernel = kernel.for_polarity(*polarity);
        lanes.find_edges(
            image,
            &kernel,
            log_ratio_image.map(|log_ratio_image| (log_ratio_image, &SCORING)),
        );
    }
}

impl Kernel {
    fn new(scale_px: f64, options: &SearchOptions) -> Self {
        let reach = (3.0 * scale_px).ceil() as usize;
        let raw = |k: usize| {
            let x = k as f64 / scale_px;
            x * (-0.5 * x * x).exp()
        };
        let sum: f64 = (1..=reach).map(raw).sum();
        let unit = f64::from(1_u32 << 16) / sum;
        let blurred_scale_px = scale_px.hypot(options.blur_px);
        let contrast_per_answer = blurred_scale_px / (scale_px * lanes::ANSWER_UNIT);
        let least = (options.min_contrast_grey / contrast_per_answer).ceil();
        Self {
            weights: (1..=reach).map(|k| (unit * raw(k)).round() as u16).collect(),
            // Without contrast there is no edge.
            least: least.max(1.0) as i16,
            contrast_per_answer,
            variance_at_one_grey: 0.75 * PI.sqrt() * blurred_scale_px.powi(6) / scale_px.powi(5),
        }
    }

    /// The kernel in the form that the lanes take.
    fn for_polarity(&self, polarity: Polarity) -> lanes::LaneKernel<'_> {
        lanes::LaneKernel { weights: &self.weights, least: self.least, polarity }
    }

    /// Pixels covered on either side.
    fn reach(&self) -> usize {
        self.weights.len()
    }

    /// Contrast of a blurred step with the response `answer`.
    fn contrast(&self, answer: i16) -> f64 {
        f64::from(answer) * self.contrast_per_answer
    }
}

/// Minimum difference of the mean log-likelihood ratios on the two sides of the hand's edge; the
/// ratio of a pixel is within ±3.
const MIN_SEPARATION: f32 = 1.0;
/// Variance of the offset of a change of the log-likelihood ratio \[px²\].
const LOG_RATIO_VARIANCE_PX2: f64 = 1.0;
/// Increase of an edge's score for a response e times as strong, in units of separation.
const STRENGTH_WEIGHT: f32 = 0.5;

/// Scoring of edges where an appearance model is known.
const SCORING: Scoring =
    Scoring { min_separation: MIN_SEPARATION, strength_weight: STRENGTH_WEIGHT };

/// The whole offsets from −`half` to `half` whose samples lie in the image, if zero is among them.
fn visible_span(image: &GrayView<'_>, sample: &PlacedSample, half: i32) -> Option<Span> {
    let PlacedSample { position, normal } = sample;
    let size = Vector2::new(image.width() as f64 - 1.0, image.height() as f64 - 1.0);
    let (mut from, mut to) = (-f64::from(half), f64::from(half));
    for (p, n, last) in [(position.x, normal.x, size.x), (position.y, normal.y, size.y)] {
        if !(0.0..=last).contains(&p) {
            return None;
        }
        if n != 0.0 {
            let (a, b) = ((BORDER_MARGIN_PX - p) / n, (last - BORDER_MARGIN_PX - p) / n);
            from = from.max(a.min(b));
            to = to.min(a.max(b));
        }
    }
    // If no sample is visible, the ends may be infinite.
    let (from, to) = (from.min(1.0).ceil(), to.max(-1.0).floor());
    Some(Span { from: from as i32, to: to as i32 })
}

/// Peak of the parabola through three neighbours, relative to the middle one \[samples\], within
/// ±1/2.
fn parabola_peak(answers: [i16; 3]) -> f64 {
    let [before, at, after] = answers.map(f64::from);
    let curvature = before - 2.0 * at + after;
    if curvature == 0.0 {
        return 0.0;
    }
    (0.5 * (before - after) / curvature).clamp(-0.5, 0.5)
}
