//! The pixels near the flanks, sorted into blocks along the finger.
//!
//! Pixels that are clipped (0 or 255) say only that the light was at least or at most so much, and
//! are left out. A block is a short slab of one flank; its pixels lie in chunks of [`LANES`] for
//! the arithmetic on them, the last chunk padded with pixels of no weight.

use super::sketch::{SIDES, Sketch};
use super::{KnownBackground, PhotometricOptions, Stretch};
use crate::image::GrayView;

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
    from_chunk: usize,
    to_chunk: usize,
}

/// One flank's pixels.
#[derive(Debug, Clone, Default)]
pub(super) struct Strip {
    pub blocks: Vec<Block>,
    chunks: Vec<Chunk>,
    seen: Vec<Seen>,
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

/// A part of the strip: where q = σ · v runs between two bounds.
struct Band {
    p: [f64; 2],
    v: [f64; 2],
}

impl Strip {
    pub fn chunks(&self, block: &Block) -> &[Chunk] {
        self.chunks.get(block.from_chunk..block.to_chunk).unwrap_or_default()
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
        sketch: &Sketch,
        flank: usize,
        options: &PhotometricOptions,
    ) {
        let Self { blocks, chunks, seen } = self;
        blocks.clear();
        chunks.clear();
        seen.clear();
        let Stretch { from_px, to_px } = sketch.flanks[flank];
        let (side, inner, outer) = (SIDES[flank], options.inner_px, options.outer_px);
        let block_of = |p: f64| ((p - from_px) / options.block_px) as usize;
        let mut see = |band: &Band, wanted: &dyn Fn(f64, f64) -> bool| {
            band.scan(image, sketch, side, |x, y, p, v| {
                if wanted(p, v) {
                    let (x, y, p32, v) = (x as u32, y as u32, p as f32, v as f32);
                    seen.push(Seen { block: block_of(p), x, y, p: p32, v });
                }
            });
        };
        // The straight part, up to the middle of the round end; then a part of the round end.
        let straight_to = sketch.round_end_px.map_or(to_px, |e| to_px.min(e));
        if straight_to > from_px {
            let widths = [from_px, straight_to].map(|p| sketch.half_width_at(p));
            let least = (widths[0].min(widths[1]) - inner).max(0.0);
            let most = widths[0].max(widths[1]) + outer;
            let band = Band { p: [from_px, straight_to], v: [least, most] };
            see(&band, &|p, v| {
                let outside = v - sketch.half_width_at(p);
                -inner <= outside && outside <= outer
            });
        }
        if let (Some(end), Some(radius)) = (sketch.round_end_px, sketch.end_radius_px()) {
            let from = from_px.max(end);
            let to = to_px.min(end + options.cap * radius);
            if to > from {
                see(&Band { p: [from, to], v: [0.0, radius + outer] }, &|p, v| {
                    let outside = (p - end).hypot(v) - radius;
                    p > end && -inner <= outside && outside <= outer
                });
            }
        }
        let Some(count) = seen.iter().map(|s| s.block + 1).max() else { return };
        blocks.resize(count, Block::default());
        for s in seen.iter() {
            blocks[s.block].pixels += 1;
        }
        let mut total = 0;
        for (k, block) in blocks.iter_mut().enumerate() {
            block.p = from_px + (k as f64 + 0.5) * options.block_px;
            (block.from_chunk, block.to_chunk) = (total, total);
            total += block.pixels.div_ceil(LANES);
            block.pixels = 0;
        }
        chunks.resize(total, Chunk::default());
        let outward = sketch.normal() * side;
        for s in seen.iter() {
            let (x, y) = (s.x as usize, s.y as usize);
            let Some(grey @ 1..=254) = image.pixel(x, y) else { continue };
            let local = match background {
                Some(known) => match known.local(x, y, outward) {
                    Some(local) => local,
                    None => continue,
                },
                None => [0.0; 4],
            };
            let block = &mut blocks[s.block];
            let (chunk, lane) = (block.from_chunk + block.pixels / LANES, block.pixels % LANES);
            block.pixels += 1;
            block.to_chunk = chunk + 1;
            let c = &mut chunks[chunk];
            c.p[lane] = s.p;
            c.v[lane] = s.v;
            c.grey[lane] = f32::from(grey);
            c.weight[lane] = 1.0;
            let [level, slope, curvature, doubt] = local;
            c.background[lane] = level;
            c.background_slope[lane] = slope;
            c.background_curvature[lane] = curvature;
            c.doubt[lane] = doubt;
        }
        blocks.retain(|b| b.pixels > 0);
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
