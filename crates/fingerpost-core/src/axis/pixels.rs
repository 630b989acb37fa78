//! The pixels near the flanks, sorted into blocks along the finger.
//!
//! Clipped pixels (0 or 255) bound the intensity on one side only and are left out. A block is a
//! short slab of one flank. [`LANES`] successive blocks are processed together, one per lane: sums
//! over a block's pixels, and all results of them, never cross lanes. A block with fewer pixels
//! than its neighbours is padded with pixels of zero weight. The last group, at the round end, is
//! always full; the first one may have lanes without a block.
//!
//! A learned background may lie in the shadow of the hand, or may no longer be behind the finger.
//! Pixels further out than the fitted ones decide this per block: the median of their ratios to the
//! background is the fraction of light left by the shadow. Where they disagree with the background
//! even then, the block is left out.

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]

use super::Stretch;
use super::finger_estimate::{FingerEstimate, SIDES};
use super::visible_flanks::VisibleFlank;
use crate::axis::{KnownBackground, PhotometricOptions};
use crate::image::gray::GrayView;
use nalgebra::Vector2;

/// Number of blocks processed at once.
pub(super) const LANES: usize = 8;
pub(super) type PixelLanes = [f32; LANES];
/// Results of sums over pixels, for which single precision is insufficient.
pub(super) type Doubles = [f64; LANES];

/// The sum of all lanes.
#[inline(always)]
pub(super) fn total([a, b, c, d, e, f, g, h]: &Doubles) -> f64 {
    // Halves first: one addition of vectors each.
    ((a + e) + (c + g)) + ((b + f) + (d + h))
}

/// One pixel of every block of a group.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Chunk {
    /// Along the finger \[px\].
    pub p: PixelLanes,
    /// Across it, outward for the flank's side \[px\].
    pub v: PixelLanes,
    pub grey: PixelLanes,
    /// 1, or 0 for padding.
    pub weight: PixelLanes,
    /// The known background, or zero, \[grey levels\] and its first and second derivative outward.
    pub background: PixelLanes,
    pub background_slope: PixelLanes,
    pub background_curvature: PixelLanes,
    /// Variance of the known background \[grey levels²\].
    pub variance: PixelLanes,
}

/// A slab of one flank.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Block {
    /// Abscissa of the slab's middle \[px\].
    pub p: f64,
    pub pixels: usize,
    /// Mean level of the known background behind it, or zero \[grey levels\].
    pub behind: f64,
    /// Illumination of the known background behind it: 1, less in a shadow, 0 where the background
    /// is absent.
    background_light: f32,
    /// Index among the lanes of all groups.
    slot: usize,
}

/// Blocks that are processed together.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct BlockGroup {
    /// The middles of the slabs; that of a neighbour in a lane without a block.
    pub p: Doubles,
    /// 1, or 0 in a lane without a block.
    pub is_block: Doubles,
    from_chunk: usize,
    to_chunk: usize,
}

/// The pixels of one flank.
#[derive(Debug, Clone)]
pub(super) struct Strip {
    pub blocks: Vec<Block>,
    pub groups: Vec<BlockGroup>,
    chunks: Vec<Chunk>,
    gathered: Vec<StripPixel>,
    /// The next free chunk of every lane of every group.
    filled: Vec<usize>,
    background_pixels: Vec<BackgroundPixel>,
    ratios: Vec<f32>,
    usable: f64,
}

/// A pixel outside the strip, used to estimate the illumination of the background.
#[derive(Debug, Clone, Copy)]
struct BackgroundPixel {
    p: f64,
    grey: f32,
    /// The learned level and its variance.
    level: f32,
    variance: f32,
}

/// A pixel to be put into a block.
#[derive(Debug, Clone, Copy)]
struct StripPixel {
    block: usize,
    x: u32,
    y: u32,
    p: f32,
    v: f32,
    grey: f32,
    /// The known background, its derivatives and its variance, or zeros: as in [`Chunk`].
    behind: [f32; 4],
}

/// A pixel of the image, with its coordinates in the finger's frame.
#[derive(Debug, Clone, Copy)]
struct Pixel {
    x: u32,
    y: u32,
    grey: u8,
    p: f64,
    v: f64,
}

/// A rectangle of the finger's frame: between bounds of p and of v = σ q.
struct StripBand {
    p: [f64; 2],
    v: [f64; 2],
}

/// Capacity of a strip, in blocks and in pixels per block; larger strips allocate.
pub(super) const USUAL_BLOCKS: usize = 128;
pub(super) const USUAL_PIXELS: usize = 32;

/// Background pixels are taken at these distances outside the edge, beyond its blur \[px\],
const BACKGROUND_DISTANCE_PX: std::ops::RangeInclusive<i32> = 4..=8;
/// and within this distance along the finger from the middle of a block \[px\].
const BACKGROUND_REACH_PX: f64 = 6.0;
/// Minimum number of background pixels that determine a block's illumination.
const MIN_BACKGROUND_PIXELS: usize = 12;
/// Tolerance of a background pixel, in standard deviations, and as a fraction of the level besides:
/// shadows have soft edges.
const AGREES_SIGMAS: f32 = 4.0;
const AGREES_PART: f32 = 0.04;
/// Minimum fraction of agreeing pixels where the background is present.
const LEAST_AGREEING: f64 = 0.6;
/// Range of illumination in a shadow. Other ratios are taken as no shadow; those near 1 are noise.
const SHADOWS: std::ops::Range<f32> = 0.25..0.97;
/// Background levels below this determine no ratio \[grey levels\].
const DARK_GREY: f32 = 8.0;

impl Strip {
    pub fn new() -> Self {
        Self {
            blocks: Vec::with_capacity(USUAL_BLOCKS),
            groups: Vec::with_capacity(USUAL_BLOCKS.div_ceil(LANES)),
            chunks: Vec::with_capacity(USUAL_BLOCKS.div_ceil(LANES) * USUAL_PIXELS),
            gathered: Vec::with_capacity(USUAL_BLOCKS * USUAL_PIXELS),
            filled: Vec::with_capacity(USUAL_BLOCKS + LANES),
            background_pixels: Vec::with_capacity(
                BACKGROUND_DISTANCE_PX.count() * 4 * USUAL_BLOCKS,
            ),
            ratios: Vec::with_capacity(BACKGROUND_DISTANCE_PX.count() * 4 * USUAL_BLOCKS),
            usable: 0.0,
        }
    }

    #[inline]
    pub fn chunks(&self, group: &BlockGroup) -> &[Chunk] {
        self.chunks.get(group.from_chunk..group.to_chunk).unwrap_or_default()
    }

    /// The largest number of pixels of a block.
    pub fn most_pixels(&self) -> usize {
        self.groups.iter().map(|g| g.to_chunk - g.from_chunk).max().unwrap_or(0)
    }

    /// Index of the first block among the lanes of all groups; the others follow it.
    pub fn first_slot(&self) -> usize {
        self.blocks.first().map_or(0, |b| b.slot)
    }

    /// Fraction of the blocks with pixels after clipping and the comparison with the background,
    /// 0–1.
    pub fn usable(&self) -> f64 {
        self.usable
    }

    /// Contrast of a finger whose level is `above_grey`, relative to the known background if there
    /// is one: root mean square over the blocks, with the sign of the mean.
    pub fn contrast_grey(&self, above_grey: f64) -> f64 {
        let (mut sum, mut squares) = (0.0, 0.0);
        for block in &self.blocks {
            let contrast = above_grey - block.behind;
            sum += contrast;
            squares += contrast * contrast;
        }
        (squares / self.blocks.len().max(1) as f64).sqrt().copysign(sum)
    }

    /// Number of usable pixels in all blocks.
    pub fn pixels(&self) -> usize {
        self.blocks.iter().map(|b| b.pixels).sum()
    }

    /// Collects the pixels of a flank near the estimate, where the flank is visible.
    pub fn gather(
        &mut self,
        image: &GrayView<'_>,
        background: Option<&KnownBackground<'_>>,
        noise_grey: f64,
        estimate: &FingerEstimate,
        flank: &VisibleFlank<'_>,
        options: &PhotometricOptions,
    ) {
        let (visible, flank) = (flank, flank.index);
        let outer_px = if background.is_some() { options.known_outer_px } else { options.outer_px };
        self.add_pixels(image, estimate, flank, [options.inner_px, outer_px], options);
        self.divide(estimate.flanks[flank].from_px, options.block_px);
        if visible.is_partly_covered() {
            let Self { blocks, gathered, .. } = self;
            gathered.retain(|s| visible.is_visible(blocks[s.block].p));
        }
        if let Some(known) = background {
            self.gather_background(image, known, estimate, flank);
            self.background_light(noise_grey as f32);
            self.attach_background(known, estimate.normal() * SIDES[flank]);
        }
        self.group();
        self.fill();
    }

    /// Collects the background pixels of a flank.
    fn gather_background(
        &mut self,
        image: &GrayView<'_>,
        background: &KnownBackground<'_>,
        estimate: &FingerEstimate,
        flank: usize,
    ) {
        let Stretch { from_px, to_px } = estimate.flanks[flank];
        self.background_pixels.clear();
        let mut p = from_px;
        while p <= to_px {
            for outside_px in BACKGROUND_DISTANCE_PX {
                let q = SIDES[flank] * (estimate.half_width_at(p) + f64::from(outside_px));
                let place = estimate.place(p, q);
                if !image.contains(place.x, place.y, 0.0) {
                    continue;
                }
                let (x, y) = (place.x.round() as usize, place.y.round() as usize);
                if let (Some(grey @ 1..=254), Some([level, variance])) =
                    (image.pixel(x, y), background.level(x, y))
                {
                    self.background_pixels.push(BackgroundPixel {
                        p,
                        grey: f32::from(grey),
                        level,
                        variance,
                    });
                }
            }
            p += 1.0;
        }
    }

    /// Estimates the illumination of the background behind each block: 1, the fraction left by a
    /// shadow, or 0 where the background is absent.
    fn background_light(&mut self, noise_grey: f32) {
        let Self { blocks, background_pixels, ratios, .. } = self;
        for block in blocks {
            let nearby = || {
                background_pixels.iter().filter(|w| (w.p - block.p).abs() <= BACKGROUND_REACH_PX)
            };
            ratios.clear();
            ratios.extend(nearby().filter(|w| w.level >= DARK_GREY).map(|w| w.grey / w.level));
            let middle = ratios.len() / 2;
            let ratio = if ratios.len() < MIN_BACKGROUND_PIXELS {
                1.0
            } else {
                *ratios.select_nth_unstable_by(middle, f32::total_cmp).1
            };
            let background_light = if SHADOWS.contains(&ratio) { ratio } else { 1.0 };
            let agrees = |w: &&BackgroundPixel| {
                let sigma = (noise_grey * noise_grey + w.variance).sqrt();
                (w.grey - background_light * w.level).abs()
                    < AGREES_SIGMAS * sigma + AGREES_PART * w.level
            };
            let (all, agreeing) = (nearby().count(), nearby().filter(agrees).count());
            let is_present = agreeing as f64 >= LEAST_AGREEING * all as f64;
            block.background_light = if is_present { background_light } else { 0.0 };
        }
    }

    /// Collects the usable pixels of the strip: along the straight part up to the centre of the
    /// round end, and along a part of the round end.
    fn add_pixels(
        &mut self,
        image: &GrayView<'_>,
        estimate: &FingerEstimate,
        flank: usize,
        [inner, outer]: [f64; 2],
        options: &PhotometricOptions,
    ) {
        let Stretch { from_px, to_px } = estimate.flanks[flank];
        let side = SIDES[flank];
        let per_block = options.block_px.recip();
        let Self { gathered, blocks, .. } = self;
        gathered.clear();
        let mut blocks_seen = 0;
        let mut add_pixels = |Pixel { x, y, grey, p, v }: Pixel, outside: f64| {
            if outside < -inner || outside > outer {
                return;
            }
            let block = ((p - from_px) * per_block) as u32;
            blocks_seen = blocks_seen.max(block + 1);
            if matches!(grey, 1..=254) {
                let (block, p, v) = (block as usize, p as f32, v as f32);
                gathered.push(StripPixel {
                    block,
                    x,
                    y,
                    p,
                    v,
                    grey: f32::from(grey),
                    behind: [0.0; 4],
                });
            }
        };
        let straight_to = estimate.round_end_px.map_or(to_px, |e| to_px.min(e));
        if straight_to > from_px {
            let [a, b] = [from_px, straight_to].map(|p| estimate.half_width_at(p));
            let v = [(a.min(b) - inner).max(0.0), a.max(b) + outer];
            let band = StripBand { p: [from_px, straight_to], v };
            band.scan(image, estimate, side, |pixel| {
                add_pixels(pixel, pixel.v - estimate.half_width_at(pixel.p));
            });
        }
        if let (Some(end), Some(radius)) = (estimate.round_end_px, estimate.end_radius_px()) {
            // The centre itself belongs to the straight part.
            let p = [from_px.max(end).next_up(), to_px.min(end + options.cap * radius)];
            if p[1] > p[0] {
                let band = StripBand { p, v: [0.0, radius + outer] };
                band.scan(image, estimate, side, |pixel| {
                    let (u, v) = (pixel.p - end, pixel.v);
                    add_pixels(pixel, (u * u + v * v).sqrt() - radius);
                });
            }
        }
        blocks.clear();
        blocks.resize(blocks_seen as usize, Block::default());
    }

    /// Assigns the blocks their abscissae.
    fn divide(&mut self, from_px: f64, block_px: f64) {
        for (k, block) in self.blocks.iter_mut().enumerate() {
            (block.p, block.background_light) = (from_px + (k as f64 + 0.5) * block_px, 1.0);
        }
    }

    /// Adds the known background to the pixels, and drops those without one.
    fn attach_background(&mut self, known: &KnownBackground<'_>, outward: Vector2<f64>) {
        let Self { blocks, gathered, .. } = self;
        gathered.retain_mut(|s| {
            let background_light = blocks[s.block].background_light;
            let Some([level, slope, curvature, variance]) =
                known.local(s.x as usize, s.y as usize, outward).filter(|_| background_light > 0.0)
            else {
                return false;
            };
            s.behind = [
                background_light * level,
                background_light * slope,
                background_light * curvature,
                background_light * background_light * variance,
            ];
            true
        });
    }

    /// Arranges the blocks that have pixels in groups.
    fn group(&mut self) {
        let Self { blocks, groups, chunks, gathered, usable, .. } = self;
        for s in &*gathered {
            let block = &mut blocks[s.block];
            block.pixels += 1;
            block.behind += f64::from(s.behind[0]);
        }
        let block_count = blocks.len();
        let used = blocks.iter().filter(|b| b.pixels > 0).count();
        *usable = used as f64 / block_count.max(1) as f64;
        let count = used.div_ceil(LANES);
        let first = count * LANES - used;
        let with_pixels = blocks.iter_mut().filter(|b| b.pixels > 0);
        for (slot, block) in (first..).zip(with_pixels) {
            block.slot = slot;
            block.behind /= block.pixels as f64;
        }
        // From here on a pixel's block is an index among the lanes.
        for s in &mut *gathered {
            s.block = blocks[s.block].slot;
        }
        blocks.retain(|b| b.pixels > 0);
        groups.clear();
        groups.resize(count, BlockGroup::default());
        if let (Some(group), Some(block)) = (groups.first_mut(), blocks.first()) {
            group.p = [block.p; LANES];
        }
        for block in &*blocks {
            let (group, lane) = (&mut groups[block.slot / LANES], block.slot % LANES);
            (group.p[lane], group.is_block[lane]) = (block.p, 1.0);
            group.to_chunk = group.to_chunk.max(block.pixels);
        }
        let mut total = 0;
        for group in groups {
            (group.from_chunk, group.to_chunk) = (total, total + group.to_chunk);
            total = group.to_chunk;
        }
        chunks.clear();
        chunks.resize(total, Chunk::default());
    }

    /// Puts the pixels into their blocks.
    fn fill(&mut self) {
        let Self { groups, chunks, gathered, filled, .. } = self;
        filled.clear();
        filled.extend(groups.iter().flat_map(|group| [group.from_chunk; LANES]));
        for s in gathered {
            let (next, lane) = (&mut filled[s.block], s.block % LANES);
            let chunk = &mut chunks[*next];
            *next += 1;
            chunk.p[lane] = s.p;
            chunk.v[lane] = s.v;
            chunk.grey[lane] = s.grey;
            chunk.weight[lane] = 1.0;
            let [level, slope, curvature, variance] = s.behind;
            chunk.background[lane] = level;
            chunk.background_slope[lane] = slope;
            chunk.background_curvature[lane] = curvature;
            chunk.variance[lane] = variance;
        }
    }
}

impl StripBand {
    /// Calls `at` with every pixel of the image in the band.
    fn scan(
        &self,
        image: &GrayView<'_>,
        estimate: &FingerEstimate,
        side: f64,
        mut at: impl FnMut(Pixel),
    ) {
        let (e, n, o) = (estimate.along, estimate.normal() * side, estimate.origin);
        let corner = |p: f64, v: f64| estimate.place(p, side * v).y;
        let [p, v] = [self.p, self.v];
        let ys = [corner(p[0], v[0]), corner(p[0], v[1]), corner(p[1], v[0]), corner(p[1], v[1])];
        let top = ys.iter().copied().fold(f64::INFINITY, f64::min).ceil().max(0.0);
        let bottom = ys.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let bottom = bottom.min(image.height() as f64 - 1.0);
        if top > bottom {
            return;
        }
        for y in top as u32..=bottom as u32 {
            let Some(row) = image.row(y as usize) else { return };
            let dv = f64::from(y) - o.y;
            // p and v grow linearly along a row: each bound is an interval of x.
            let (mut from, mut to) = (0.0, image.width() as f64 - 1.0);
            for (direction, [low, high]) in [(e, p), (n, v)] {
                let at_zero = dv * direction.y - o.x * direction.x;
                if direction.x.abs() > 1e-9 {
                    let per_px = 1.0 / direction.x;
                    let ends = [(low - at_zero) * per_px, (high - at_zero) * per_px];
                    from = ends[0].min(ends[1]).max(from);
                    to = ends[0].max(ends[1]).min(to);
                } else if !(low..=high).contains(&at_zero) {
                    to = -1.0;
                }
            }
            let from = from.ceil();
            if from > to {
                continue;
            }
            let (from, to) = (from as u32, to as u32);
            let greys = row.get(from as usize..=to as usize).unwrap_or_default();
            let [at_p, at_v] = [e, n].map(|d| dv * d.y - o.x * d.x);
            for (x, &grey) in (from..).zip(greys) {
                let u = f64::from(x);
                at(Pixel { x, y, grey, p: at_p + u * e.x, v: at_v + u * n.x });
            }
        }
    }
}
