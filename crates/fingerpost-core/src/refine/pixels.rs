//! The pixels near the flanks, sorted into blocks along the finger.
//!
//! Pixels that are clipped (0 or 255) say only that the light was at least or at most so much, and
//! are left out. A block is a short slab of one flank; its pixels lie in chunks of [`LANES`] for
//! the arithmetic on them, the last chunk padded with pixels of no weight.
//!
//! A known background may lie in the shadow of the hand, or not be what is behind the finger now.
//! Pixels further out than those that are fitted tell, block by block: their middle ratio to the
//! background is the light that the shadow leaves, and where they do not agree with the background
//! even then, the block is left out.

use super::sketch::{SIDES, Sketch};
use super::{KnownBackground, PhotometricOptions, Stretch};
use crate::image::GrayView;
use nalgebra::Vector2;

/// How many pixels are worked on at once.
pub(super) const LANES: usize = 8;
pub(super) type Lanes = [f32; LANES];

/// Some pixels of one block.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Chunk {
    /// Along the finger \[px\].
    pub p: Lanes,
    /// Across it, outward for the flank's side \[px\].
    pub v: Lanes,
    pub grey: Lanes,
    /// 1, or 0 for padding.
    pub weight: Lanes,
    /// The known background, or zero, \[grey levels\] and its first and second derivative outward.
    pub background: Lanes,
    pub background_slope: Lanes,
    pub background_curvature: Lanes,
    /// Variance of the known background \[grey levels²\].
    pub doubt: Lanes,
}

/// A slab of one flank.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Block {
    /// The middle of the slab.
    pub p: f64,
    pub pixels: usize,
    /// Mean level of the known background behind it, or zero \[grey levels\].
    pub behind: f64,
    /// How the known background behind it is lit: 1, less in a shadow, 0 if it is not there.
    light: f32,
    from_chunk: usize,
    to_chunk: usize,
}

/// One flank's pixels.
#[derive(Debug, Clone)]
pub(super) struct Strip {
    pub blocks: Vec<Block>,
    chunks: Vec<Chunk>,
    seen: Vec<Seen>,
    witnesses: Vec<Witness>,
    ratios: Vec<f32>,
    usable: f64,
}

/// A pixel outside the strip, that shows how the background is lit.
#[derive(Debug, Clone, Copy)]
struct Witness {
    p: f64,
    grey: f32,
    /// The known level and its variance.
    level: f32,
    doubt: f32,
}

/// A pixel on its way into a block.
#[derive(Debug, Clone, Copy)]
struct Seen {
    block: usize,
    x: u32,
    y: u32,
    p: f32,
    v: f32,
}

/// A rectangle of the finger's frame: between bounds of p and of v = σ q.
struct Band {
    p: [f64; 2],
    v: [f64; 2],
}

/// A strip of so many blocks, of 32 pixels each, fits without another allocation.
pub(super) const USUAL_BLOCKS: usize = 128;
/// Most blocks have no more than so many chunks.
pub(super) const USUAL_CHUNKS: usize = 16;

/// Witnesses stand outside the edge from here to there, beyond its blur \[px\],
const WITNESSES_PX: std::ops::RangeInclusive<i32> = 4..=8;
/// and are heard this far along the finger from the middle of a block \[px\].
const HEARD_PX: f64 = 6.0;
/// Fewer than this tell nothing of a block's light.
const LEAST_WITNESSES: usize = 12;
/// A witness agrees within this many standard deviations, and this part of the level: shadows have
/// soft edges.
const AGREES_SIGMAS: f32 = 4.0;
const AGREES_PART: f32 = 0.04;
/// As many of them agree if the background is what is there.
const LEAST_AGREEING: f64 = 0.6;
/// What a shadow leaves of the light; more is none, and this close to 1 it is noise.
const SHADOWS: std::ops::Range<f32> = 0.25..0.97;
/// Levels below this tell no ratio \[grey levels\].
const DARK_GREY: f32 = 8.0;

impl Strip {
    pub fn new() -> Self {
        Self {
            blocks: Vec::with_capacity(USUAL_BLOCKS),
            chunks: Vec::with_capacity(4 * USUAL_BLOCKS),
            seen: Vec::with_capacity(4 * LANES * USUAL_BLOCKS),
            witnesses: Vec::with_capacity(WITNESSES_PX.count() * 4 * USUAL_BLOCKS),
            ratios: Vec::with_capacity(WITNESSES_PX.count() * 4 * USUAL_BLOCKS),
            usable: 0.0,
        }
    }

    #[inline]
    pub fn chunks(&self, block: &Block) -> &[Chunk] {
        self.chunks.get(block.from_chunk..block.to_chunk).unwrap_or_default()
    }

    /// The most chunks that a block has.
    pub fn most_chunks(&self) -> usize {
        self.blocks.iter().map(|b| b.to_chunk - b.from_chunk).max().unwrap_or(0)
    }

    /// The part of the blocks that the frame and what is known of the background leave, 0–1.
    pub fn usable(&self) -> f64 {
        self.usable
    }

    /// How much a finger contrasts with what is behind it, that is `above_grey` above zero where
    /// nothing is known of that: root mean square over the blocks, with the sign of the mean.
    pub fn contrast_grey(&self, above_grey: f64) -> f64 {
        let (mut sum, mut squares) = (0.0, 0.0);
        for block in &self.blocks {
            let contrast = above_grey - block.behind;
            sum += contrast;
            squares += contrast * contrast;
        }
        (squares / self.blocks.len().max(1) as f64).sqrt().copysign(sum)
    }

    /// All usable pixels in the block.
    pub fn pixels(&self) -> usize {
        self.blocks.iter().map(|b| b.pixels).sum()
    }

    /// Collects the pixels of flank `flank` (0 right, 1 left) near where the sketch has it.
    pub fn gather(
        &mut self,
        image: &GrayView<'_>,
        background: Option<&KnownBackground<'_>>,
        noise_grey: f64,
        sketch: &Sketch,
        flank: usize,
        options: &PhotometricOptions,
    ) {
        self.see(image, sketch, flank, options);
        self.divide(sketch.flanks[flank].from_px, options.block_px);
        if let Some(known) = background {
            self.hear(image, known, sketch, flank);
            self.light(noise_grey as f32);
        }
        self.fill(image, background, sketch.normal() * SIDES[flank]);
    }

    /// Collects the witnesses of a flank.
    fn hear(
        &mut self,
        image: &GrayView<'_>,
        background: &KnownBackground<'_>,
        sketch: &Sketch,
        flank: usize,
    ) {
        let Stretch { from_px, to_px } = sketch.flanks[flank];
        self.witnesses.clear();
        let mut p = from_px;
        while p <= to_px {
            for away in WITNESSES_PX {
                let q = SIDES[flank] * (sketch.half_width_at(p) + f64::from(away));
                let place = sketch.place(p, q);
                if !image.contains(place.x, place.y, 0.0) {
                    continue;
                }
                let (x, y) = (place.x.round() as usize, place.y.round() as usize);
                if let (Some(grey @ 1..=254), Some([level, doubt])) =
                    (image.pixel(x, y), background.level(x, y))
                {
                    self.witnesses.push(Witness { p, grey: f32::from(grey), level, doubt });
                }
            }
            p += 1.0;
        }
    }

    /// Tells how the background behind each block is lit: 1, what a shadow leaves, or 0 if what is
    /// there is not the background.
    fn light(&mut self, noise_grey: f32) {
        let Self { blocks, witnesses, ratios, .. } = self;
        for block in blocks {
            let heard = || witnesses.iter().filter(|w| (w.p - block.p).abs() <= HEARD_PX);
            ratios.clear();
            ratios.extend(heard().filter(|w| w.level >= DARK_GREY).map(|w| w.grey / w.level));
            let middle = ratios.len() / 2;
            let ratio = if ratios.len() < LEAST_WITNESSES {
                1.0
            } else {
                *ratios.select_nth_unstable_by(middle, f32::total_cmp).1
            };
            let light = if SHADOWS.contains(&ratio) { ratio } else { 1.0 };
            let agrees = |w: &&Witness| {
                let sigma = (noise_grey * noise_grey + w.doubt).sqrt();
                (w.grey - light * w.level).abs() < AGREES_SIGMAS * sigma + AGREES_PART * w.level
            };
            let (all, agreeing) = (heard().count(), heard().filter(agrees).count());
            let is_there = agreeing as f64 >= LEAST_AGREEING * all as f64;
            block.light = if is_there { light } else { 0.0 };
        }
    }

    /// Finds the pixels of the strip: along the straight part up to the middle of the round end, and
    /// about a part of that.
    fn see(
        &mut self,
        image: &GrayView<'_>,
        sketch: &Sketch,
        flank: usize,
        options: &PhotometricOptions,
    ) {
        let Stretch { from_px, to_px } = sketch.flanks[flank];
        let (inner, outer) = (options.inner_px, options.outer_px);
        let strip = -inner..=outer;
        let seen = &mut self.seen;
        seen.clear();
        let mut scan = |band: &Band, outside: &dyn Fn(f64, f64) -> f64| {
            band.scan(image, sketch, SIDES[flank], |x, y, p, v| {
                if strip.contains(&outside(p, v)) {
                    let block = ((p - from_px) / options.block_px) as usize;
                    let (x, y, p, v) = (x as u32, y as u32, p as f32, v as f32);
                    seen.push(Seen { block, x, y, p, v });
                }
            });
        };
        let straight_to = sketch.round_end_px.map_or(to_px, |e| to_px.min(e));
        if straight_to > from_px {
            let [a, b] = [from_px, straight_to].map(|p| sketch.half_width_at(p));
            let v = [(a.min(b) - inner).max(0.0), a.max(b) + outer];
            let band = Band { p: [from_px, straight_to], v };
            scan(&band, &|p, v| v - sketch.half_width_at(p));
        }
        if let (Some(end), Some(radius)) = (sketch.round_end_px, sketch.end_radius_px()) {
            // The middle itself belongs to the straight part.
            let p = [from_px.max(end).next_up(), to_px.min(end + options.cap * radius)];
            if p[1] > p[0] {
                let band = Band { p, v: [0.0, radius + outer] };
                scan(&band, &|p, v| (p - end).hypot(v) - radius);
            }
        }
    }

    /// Makes room for what was seen, block by block.
    fn divide(&mut self, from_px: f64, block_px: f64) {
        let count = self.seen.iter().map(|s| s.block + 1).max().unwrap_or(0);
        self.blocks.clear();
        self.blocks.resize(count, Block::default());
        for s in &self.seen {
            self.blocks[s.block].pixels += 1;
        }
        let mut total = 0;
        for (k, block) in self.blocks.iter_mut().enumerate() {
            block.p = from_px + (k as f64 + 0.5) * block_px;
            (block.from_chunk, block.to_chunk) = (total, total);
            total += block.pixels.div_ceil(LANES);
            (block.pixels, block.light) = (0, 1.0);
        }
        self.chunks.clear();
        self.chunks.resize(total, Chunk::default());
    }

    /// Puts the usable ones of the pixels seen into their blocks.
    fn fill(
        &mut self,
        image: &GrayView<'_>,
        background: Option<&KnownBackground<'_>>,
        outward: Vector2<f64>,
    ) {
        for s in &self.seen {
            let (x, y) = (s.x as usize, s.y as usize);
            let Some(grey @ 1..=254) = image.pixel(x, y) else { continue };
            let behind = match background {
                Some(known) => known.local(x, y, outward),
                None => Some([0.0; 4]),
            };
            let Some([level, slope, curvature, doubt]) = behind else { continue };
            let block = &mut self.blocks[s.block];
            let light = block.light;
            if light == 0.0 {
                continue;
            }
            let (chunk, lane) = (block.from_chunk + block.pixels / LANES, block.pixels % LANES);
            block.pixels += 1;
            block.to_chunk = chunk + 1;
            let chunk = &mut self.chunks[chunk];
            chunk.p[lane] = s.p;
            chunk.v[lane] = s.v;
            chunk.grey[lane] = f32::from(grey);
            chunk.weight[lane] = 1.0;
            chunk.background[lane] = light * level;
            chunk.background_slope[lane] = light * slope;
            chunk.background_curvature[lane] = light * curvature;
            chunk.doubt[lane] = light * light * doubt;
            block.behind += f64::from(light * level);
        }
        for block in &mut self.blocks {
            block.behind /= block.pixels.max(1) as f64;
        }
        let possible = self.blocks.len();
        self.blocks.retain(|b| b.pixels > 0);
        self.usable = self.blocks.len() as f64 / possible.max(1) as f64;
    }
}

impl Band {
    /// Calls `at` with every pixel of the image in the band, and its p and v.
    fn scan(
        &self,
        image: &GrayView<'_>,
        sketch: &Sketch,
        side: f64,
        mut at: impl FnMut(usize, usize, f64, f64),
    ) {
        let (e, n, o) = (sketch.along, sketch.normal() * side, sketch.origin);
        let corner = |p: f64, v: f64| sketch.place(p, side * v).y;
        let [p, v] = [self.p, self.v];
        let ys = [corner(p[0], v[0]), corner(p[0], v[1]), corner(p[1], v[0]), corner(p[1], v[1])];
        let top = ys.iter().copied().fold(f64::INFINITY, f64::min).ceil().max(0.0);
        let bottom = ys.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let mut y = top;
        while y <= bottom.min(image.height() as f64 - 1.0) {
            // p and v grow linearly along a row: each bound is an interval of x.
            let (mut from, mut to) = (0.0, image.width() as f64 - 1.0);
            for (direction, [low, high]) in [(e, p), (n, v)] {
                let at_zero = (y - o.y) * direction.y - o.x * direction.x;
                let ends = [(low - at_zero) / direction.x, (high - at_zero) / direction.x];
                if direction.x.abs() > 1e-9 {
                    from = ends[0].min(ends[1]).max(from);
                    to = ends[0].max(ends[1]).min(to);
                } else if !(low..=high).contains(&at_zero) {
                    to = -1.0;
                }
            }
            let mut x = from.ceil();
            while x <= to {
                let (du, dv) = (x - o.x, y - o.y);
                at(x as usize, y as usize, du * e.x + dv * e.y, du * n.x + dv * n.y);
                x += 1.0;
            }
            y += 1.0;
        }
    }
}
