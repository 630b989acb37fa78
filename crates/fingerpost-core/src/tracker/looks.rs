//! What a hand looks like: all that is learned from either side of its contour.

use super::sides::Sides;
use crate::Result;
use crate::appearance::Appearance;
use crate::discriminant::{Discriminant, DiscriminantImage, Mixture, region_about};
use crate::frame::{Frame, SidedPixel};
use crate::search::{Cue, Polarity};
use crate::shape_space::{Axis, PlacedSample, RibbonVector};
use crate::template::Part;
use nalgebra::{Point2, Vector2};

/// The edge itself, this far to either side, is of neither colour; looks are learned up to that
/// far from it \[px\].
const EDGE_PX: f64 = 2.0;
const REACH_PX: f64 = 14.0;
/// An edge is a flank's if its normal points aside by this much at least.
const ASIDE: f64 = 0.7;
/// Ahead of the tip they are learned so many half-widths further, but no further than that \[px\].
const AHEAD_WIDTHS: f64 = 5.0;
const MOST_REACH_PX: f64 = 120.0;

/// A finger is looked at in steps along its length of this part of its half-width and at least \[px\],
/// and in so many places across it, up to this part of the half-width from its axis.
const STEP_WIDTHS: f64 = 1.0 / 8.0;
const LEAST_STEP_PX: f64 = 1.0;
const PLACES: usize = 5;
const ACROSS: f64 = 0.6;
/// What is beside a flank is looked at so far from the edge's own pixels \[half-widths\].
const BESIDE: [f64; 3] = [0.2, 0.4, 0.6];
/// A stretch of it that counts: so many steps.
const STRETCH: usize = 3;
/// What lies ahead of its tip is looked at this far \[half-widths\].
const AHEAD: f64 = 3.0;
/// That is a part of it, as of a pattern's band, if it votes for the hand by more than this part of what
/// the finger does, or without colours by anything. A finger whose shadow lies ahead of it, before a brown
/// table, was taken for a band by 0.27.
const GOES_ON: f64 = 0.3;
/// What looks like the hand votes for it by this much on average.
const LIKE_HAND: f64 = 1.0;
/// Where there is no edge, the hand is told from what is behind it by mean colours so far from the edge
/// \[px\]; if these differ by so much, in all channels together, something else is behind it than looks
/// know of \[grey levels\].
const BEHIND_PX: [f64; 2] = [2.0 * EDGE_PX, 10.0];
const INSIDE_PX: [f64; 2] = [EDGE_PX, 6.0];
const OTHER_COLOUR: f64 = 20.0;

/// What leads the contour.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Lead {
    /// The pixels' votes.
    Votes,
    /// Edges whose sides vote differently.
    HandEdges,
    /// The same of the grey image, whatever mixture of colours shows the hand best.
    GreyEdges,
    /// The strongest edge.
    AnyEdge,
}

/// How a search line sees the hand, by what is known of it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sight<'a> {
    /// What it was asked for.
    pub lead: Lead,
    pub cue: Cue<'a>,
    /// The mixture to search in place of the grey image.
    pub mixture: Option<&'a Mixture>,
    pub polarity: Polarity,
    /// How the grey image is searched beside the mixture, if it is.
    pub in_grey: Option<InGrey<'a>>,
    /// The grey levels of a hand whose looks are colours.
    pub shades: Option<&'a Appearance>,
    /// The flanks of a hand whose looks are grey levels, if edges are to look like it.
    pub sides: Option<&'a Sides>,
}

/// How a search line sees in grey a hand whose looks are colours.
#[derive(Debug, Clone, Copy)]
pub(super) struct InGrey<'a> {
    pub polarity: Polarity,
    pub colours: &'a Appearance,
    /// The flank that grey does not show, if there is one. The other one is lit: grey shows it
    /// sharply, where its colours bleed.
    pub shaded: Option<Part>,
}

impl Sight<'_> {
    /// Any edge of this polarity: all that can be looked for before a hand was seen.
    pub fn unknown(polarity: Polarity) -> Self {
        let (lead, cue) = (Lead::AnyEdge, Cue::Edges);
        Self { lead, cue, mixture: None, polarity, in_grey: None, shades: None, sides: None }
    }

    /// What lines of a part of the outline look for.
    pub fn cue_of(&self, part: Part) -> Cue<'_> {
        self.sides.and_then(|sides| sides.of(part)).map_or(self.cue, Cue::HandEdges)
    }

    /// Whether an edge of a part of the outline is the hand's own in a frame that is `shown` as this
    /// sight shows it; any is where looks tell nothing.
    pub fn is_own_of(
        &self,
        part: Part,
        frame: &Frame<'_>,
        shown: &Frame<'_>,
        edge: &PlacedSample,
    ) -> bool {
        Sight { cue: self.cue_of(part), ..*self }.is_own(frame, shown, edge)
    }

    /// The same of an edge wherever it is on the outline.
    pub fn is_own(&self, frame: &Frame<'_>, shown: &Frame<'_>, edge: &PlacedSample) -> bool {
        self.cue.appearance().is_none_or(|looks| {
            looks.is_own_edge(shown, edge.position, edge.normal) && self.has_shade(frame, edge)
        })
    }

    /// The same of an edge of the grey image, by the colours on its two sides.
    pub fn is_own_in_grey(
        &self,
        in_grey: &InGrey<'_>,
        frame: &Frame<'_>,
        edge: &PlacedSample,
    ) -> bool {
        in_grey.colours.is_own_edge(frame, edge.position, edge.normal)
            && self.has_shade(frame, edge)
    }

    /// Whether what is inside of an edge is as bright as the hand somewhere is. Bins of colour are so
    /// wide that what covers a hand may share them.
    fn has_shade(&self, frame: &Frame<'_>, edge: &PlacedSample) -> bool {
        self.shades.is_none_or(|shades| shades.has_shown(frame, edge.position, edge.normal))
    }
}

/// A finger as far as its looks are concerned.
#[derive(Debug, Clone, Copy)]
pub(super) struct Silhouette {
    /// Unit vector of pointing.
    pub ahead: Vector2<f64>,
    pub half_width_px: f64,
}

impl Silhouette {
    /// The edge itself, this far to either side, is of neither colour \[px\].
    pub const EDGE_PX: f64 = EDGE_PX;

    /// That of a band template.
    pub fn of_band(x: &RibbonVector) -> Self {
        Self { ahead: Vector2::new(x[2].cos(), x[2].sin()), half_width_px: x[3] }
    }

    /// Of these edges those of its left flank and those of its right one, by where their normals point.
    pub fn flanks<'a>(
        &self,
        edges: &'a [PlacedSample],
    ) -> [impl Iterator<Item = &'a PlacedSample> + use<'a>; 2] {
        let left = Vector2::new(self.ahead.y, -self.ahead.x);
        [left, -left].map(|side| edges.iter().filter(move |edge| edge.normal.dot(&side) > ASIDE))
    }
}

/// A finger as far as it has to show that it is of one piece, and ends.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shaft {
    pub axis: Axis,
    pub half_width_px: f64,
    pub length_px: f64,
}

impl Shaft {
    /// That of a band template of this length.
    pub fn of_band(x: &RibbonVector, length_px: f64) -> Self {
        let axis = Axis::of_finger(Point2::new(x[0], x[1]), x[2], 0.5 * length_px);
        Self { axis, half_width_px: x[3], length_px }
    }

    fn step_px(&self) -> f64 {
        (STEP_WIDTHS * self.half_width_px).max(LEAST_STEP_PX)
    }

    /// Places along it in steps \[px ahead of its tip\].
    fn steps(&self, from_px: f64, to_px: f64) -> impl Iterator<Item = f64> + use<> {
        let step_px = self.step_px();
        let count = ((to_px - from_px) / step_px).max(0.0) as usize;
        (0..count).map(move |i| from_px + i as f64 * step_px)
    }

    /// The places across it, so far ahead of its tip.
    fn across(&self, ahead_px: f64) -> impl Iterator<Item = Point2<f64>> + use<> {
        let Self { axis, half_width_px, .. } = *self;
        let (direction, normal) = (axis.direction(), axis.normal());
        let places = (0..PLACES).map(|i| 2.0 * i as f64 / (PLACES - 1) as f64 - 1.0);
        places.map(move |across| {
            axis.tip + direction * ahead_px + normal * (across * ACROSS * half_width_px)
        })
    }

    /// The mean vote there.
    fn vote(&self, frame: &Frame<'_>, looks: &Appearance, ahead_px: f64) -> f64 {
        looks.mean_vote(frame, self.across(ahead_px))
    }

    /// Where what lies ahead of it is looked at.
    pub fn places_ahead(&self) -> impl Iterator<Item = Point2<f64>> {
        [self.half_width_px, self.length_px].into_iter().flat_map(|ahead_px| self.across(ahead_px))
    }

    /// How far back from its tip a finger shows, on its right and on its left \[px\]: hand between its
    /// flanks and none beside them, at most as far as it is long. Behind its knuckle is no hand, or more
    /// of it on either side.
    pub fn shows_px(&self, frame: &Frame<'_>, looks: &Appearance) -> [f64; 2] {
        [1.0, -1.0].map(|side| {
            let (mut sum, mut best, mut end_px) = (0.0, 0.0, 0.0);
            for back_px in self.steps(self.half_width_px, self.length_px) {
                let beside = looks.mean_vote(frame, self.beside(-back_px, side));
                // No place says more than another: what is told is how many of them are a finger's.
                sum += self.vote(frame, looks, -back_px).min(-beside).clamp(-1.0, 1.0);
                if sum > best {
                    (best, end_px) = (sum, back_px);
                }
            }
            end_px
        })
    }

    /// Places beside a flank, so far ahead of the tip.
    fn beside(&self, ahead_px: f64, side: f64) -> impl Iterator<Item = Point2<f64>> + use<> {
        let Self { axis, half_width_px, .. } = *self;
        BESIDE.into_iter().map(move |out| {
            let across_px = half_width_px * (1.0 + out) + EDGE_PX;
            axis.tip + axis.direction() * ahead_px + axis.normal() * (side * across_px)
        })
    }

    /// The corners of where it is looked at, and beside.
    pub fn corners(&self) -> impl Iterator<Item = Point2<f64>> {
        [self.half_width_px, -self.length_px]
            .into_iter()
            .flat_map(|ahead_px| self.beside(ahead_px, 1.0).chain(self.beside(ahead_px, -1.0)))
    }

    /// How far ahead of its tip the hand goes on \[px\], beyond what may lie across it: to the end of
    /// the stretch that looks most like it, if that is as long as half the finger is wide.
    pub fn goes_on_px(&self, frame: &Frame<'_>, looks: &Appearance) -> f64 {
        let (mut sum, mut best, mut end_px) = (0.0_f64, 0.0, 0.0);
        for ahead_px in self.steps(self.half_width_px, self.length_px) {
            sum = sum.max(0.0) + self.vote(frame, looks, ahead_px) * self.step_px();
            if sum > best {
                (best, end_px) = (sum, ahead_px);
            }
        }
        if best >= LIKE_HAND * self.half_width_px { end_px } else { 0.0 }
    }
}

/// A contour as far as it teaches looks.
#[derive(Debug, Clone, Copy)]
pub(super) struct Contour<'a> {
    /// Where its edges are.
    pub edges: &'a [PlacedSample],
    /// Where the hand is known to end, without an edge: what is behind it there is perhaps not known yet.
    pub unseen: &'a [PlacedSample],
}

/// The looks of one hand.
#[derive(Debug, Clone)]
pub(super) struct Looks {
    /// Of colours, or of grey levels where there are none.
    plain: Appearance,
    discriminant: Discriminant,
    /// Of grey levels in the discriminant's image: what its fine shades tell is lost among the
    /// coarse bins of three channels.
    mixed: Appearance,
    /// Whether that tells hand and background apart better than `plain`.
    finer: bool,
    /// Of grey levels, beside colours.
    shades: Option<Appearance>,
    /// Of either flank, if it is to be known for itself.
    sides: Option<Sides>,
    /// The pixels of one frame.
    pixels: Vec<SidedPixel>,
    /// The flank that is as dark as what is behind it, if there is one; see
    /// [`leave_shade`](super::ContourTracker::leave_shade).
    shaded: Option<Part>,
}

impl Looks {
    pub fn new(coloured: bool) -> Self {
        Self {
            plain: Appearance::new(coloured),
            discriminant: Discriminant::default(),
            mixed: Appearance::new(false),
            finer: false,
            shades: coloured.then(|| Appearance::new(false)),
            sides: None,
            pixels: Vec::new(),
            shaded: None,
        }
    }

    /// The same of a finger that is lit from one side, if it is: of chromaticities, which do not show
    /// where it turns from the light.
    pub fn with_shaded(self, shaded: Option<Part>) -> Self {
        match shaded {
            Some(_) => Self { discriminant: Discriminant::of_chromaticity(), shaded, ..self },
            None => self,
        }
    }

    /// The same, of each flank for itself as well where there are no colours.
    pub fn with_sides(self) -> Self {
        let sides = (!self.is_coloured()).then(Sides::new);
        Self { sides, ..self }
    }

    /// Makes room for what a contour of so many samples shows.
    pub fn reserve(&mut self, samples: usize) {
        let pixels = samples * (REACH_PX + MOST_REACH_PX) as usize;
        self.pixels.reserve(pixels);
        self.sides.iter_mut().for_each(|sides| sides.reserve(pixels));
    }

    /// Forgets all.
    pub fn forget(&mut self) {
        self.plain.fade(0.0);
        self.discriminant.forget();
        self.mixed.fade(0.0);
        self.finer = false;
        self.shades.iter_mut().for_each(|shades| shades.fade(0.0));
        self.sides.iter_mut().for_each(Sides::forget);
    }

    /// Whether they were learned from colours.
    pub fn is_coloured(&self) -> bool {
        self.plain.is_coloured()
    }

    /// Keeps the hand as it is known now for good.
    pub fn anchor(&mut self) {
        self.plain.anchor();
        self.discriminant.anchor();
        self.mixed.anchor();
        self.shades.iter_mut().for_each(Appearance::anchor);
        self.sides.iter_mut().for_each(Sides::anchor);
    }

    /// Takes all over into light that is `gain` times as bright. The discriminant's image stays as
    /// it is but for its noise, and so do the levels in it.
    pub fn relight(&mut self, gain: f64) {
        self.plain.relight(gain as f32);
        self.discriminant.relight(gain);
        self.shades.iter_mut().for_each(|shades| shades.relight(gain as f32));
        self.sides.iter_mut().for_each(|sides| sides.relight(gain as f32));
    }

    /// Takes over what a frame shows on either side of a finger's contour, `times` times; what was
    /// known keeps a part `keep` of its weight.
    pub fn learn(
        &mut self,
        frame: &Frame<'_>,
        image: &mut DiscriminantImage,
        contour: &Contour<'_>,
        finger: &Silhouette,
        (keep, times): (f64, f64),
    ) -> Result<()> {
        self.gather(contour.edges, finger, AHEAD_WIDTHS);
        self.gather_behind(frame, contour.unseen);
        if self.pixels.is_empty() {
            return Ok(());
        }
        self.plain.fade(keep as f32);
        self.discriminant.fade(keep);
        self.plain.observe_all(frame, &self.pixels, times);
        self.discriminant.observe_all(frame, &self.pixels, times);
        self.plain.learn();
        if let Some(sides) = &mut self.sides {
            sides.learn(frame, contour.edges, finger, &self.plain, (keep, times));
        }
        if let Some(shades) = &mut self.shades {
            shades.fade(keep as f32);
            shades.observe_all(frame, &self.pixels, times);
            shades.learn();
        }
        // The image that the frame was searched in is there already.
        let searched = self.discriminant.mixture().copied();
        self.discriminant.learn();
        if let Some(mixture) = searched.as_ref().or(self.discriminant.mixture()) {
            let shown = image.of(
                frame,
                mixture,
                region_about(self.pixels.iter().map(|p| (p.middle(), 0.0))),
            )?;
            self.mixed.fade(keep as f32);
            self.mixed.observe_all(&shown, &self.pixels, times);
            self.mixed.learn();
        }
        self.finer = self.mixed.separation() > self.plain.separation();
        Ok(())
    }

    /// Forgets all, and tells how well what one frame shows inside of a finger's contour differs from
    /// what it shows outside of it: [`Appearance::separation`], 0–6, and nothing of what is no finger
    /// along its `shaft`.
    pub fn told_apart(
        &mut self,
        frame: &Frame<'_>,
        contour: &[PlacedSample],
        finger: &Silhouette,
        shaft: Option<&Shaft>,
    ) -> f64 {
        self.gather(contour, finger, 0.0);
        self.plain.fade(0.0);
        self.plain.observe_all(frame, &self.pixels, 1.0);
        self.plain.learn();
        if shaft.is_some_and(|shaft| !self.is_whole(frame, contour, shaft)) {
            return 0.0;
        }
        self.plain.separation()
    }

    /// Whether every stretch of a finger looks rather like its inside than like what is beside it, and
    /// what lies ahead of its tip does not: a band of a pattern is crossed by others, and goes on
    /// behind them. A finger may be shorter than its template: it is looked at as far back as its
    /// contour is seen.
    fn is_whole(&self, frame: &Frame<'_>, contour: &[PlacedSample], shaft: &Shaft) -> bool {
        let Shaft { axis, half_width_px, length_px } = *shaft;
        let vote = |ahead_px: f64| shaft.vote(frame, &self.plain, ahead_px);
        let mut stretch = [0.0; STRETCH];
        let behind = contour.iter().map(|seen| (axis.tip - seen.position).dot(&axis.direction()));
        let seen_px = behind.fold(0.0, f64::max).min(length_px) - 0.5 * half_width_px;
        let mut inside = 0.0;
        let back = shaft.steps(half_width_px, seen_px).zip(1..);
        for (back_px, steps) in back {
            let likely = vote(-back_px);
            stretch[steps % STRETCH] = likely;
            if steps >= STRETCH && stretch.iter().sum::<f64>() < 0.0 {
                return false;
            }
            // The mean of all so far.
            inside += (likely - inside) / steps as f64;
        }
        let most = if self.is_coloured() { GOES_ON * inside } else { 0.0 };
        let ahead = shaft.steps(2.0 * EDGE_PX, AHEAD * half_width_px);
        ahead.map(|ahead_px| vote(ahead_px) - most).sum::<f64>() <= 0.0
    }

    /// Whether a mixture of colours shows the hand better than the grey image.
    pub fn is_mixed(&self) -> bool {
        self.discriminant.mixture().is_some()
    }

    /// How to look for the hand in a frame; none if it shows no colours and only these are known.
    pub fn sight(&self, frame: &Frame<'_>, lead: Lead, polarity: Polarity) -> Option<Sight<'_>> {
        let coloured = frame.colour().is_some();
        if self.is_coloured() && !coloured {
            return None;
        }
        let mixture = self.discriminant.mixture().filter(|_| coloured);
        let finer = mixture.is_some() && self.finer;
        let known = if finer { &self.mixed } else { &self.plain };
        // In the discriminant's image the hand is the brighter side.
        let in_mixture = if mixture.is_some() { Polarity::Bright } else { polarity };
        let in_grey = InGrey { polarity, colours: &self.plain, shaded: self.shaded };
        let (cue, mixture, polarity) = match lead {
            Lead::Votes => (Cue::Votes(known), mixture.filter(|_| finer), in_mixture),
            Lead::HandEdges => (Cue::HandEdges(known), mixture, in_mixture),
            Lead::GreyEdges => (Cue::HandEdges(&self.plain), None, polarity),
            Lead::AnyEdge => (Cue::Edges, mixture, in_mixture),
        };
        let in_grey = (lead == Lead::HandEdges && mixture.is_some()).then_some(in_grey);
        let sides = self.sides.as_ref().filter(|_| lead == Lead::HandEdges);
        Some(Sight { lead, cue, mixture, polarity, in_grey, shades: self.shades.as_ref(), sides })
    }

    /// Adds pixels of what is behind a hand that ends where there is no edge: the mixture that tells the
    /// hand from what was behind it elsewhere may not tell it from this. It is no more of the hand if it
    /// is of another colour than the inside, which must look like the hand: what covers that does not.
    fn gather_behind(&mut self, frame: &Frame<'_>, unseen: &[PlacedSample]) {
        let Some(colours) = frame.colour() else { return };
        for PlacedSample { position, normal } in unseen {
            let along = |[from_px, to_px]: [f64; 2], way: f64| {
                SidedPixel::along(*position, normal * way, from_px, to_px, false)
            };
            let inside = along(INSIDE_PX, -1.0);
            let differ = colours.mean(inside.clone()).zip(colours.mean(along(BEHIND_PX, 1.0)));
            let differ = differ.is_some_and(|(a, b)| (a - b).norm() >= OTHER_COLOUR);
            let places = inside.map(|pixel| pixel.middle());
            if differ && self.plain.mean_vote(frame, places) >= LIKE_HAND {
                self.pixels.extend(along([2.0 * EDGE_PX, REACH_PX], 1.0));
            }
        }
    }

    /// Pixels on either side of a contour, and so many half-widths more ahead of the tip.
    fn gather(&mut self, contour: &[PlacedSample], finger: &Silhouette, ahead_widths: f64) {
        let depth_px = (2.0 * finger.half_width_px - EDGE_PX).clamp(3.0, REACH_PX);
        self.pixels.clear();
        for PlacedSample { position, normal } in contour {
            // Ahead of a fingertip there is nothing of the hand, and it may go there next.
            let ahead_px = normal.dot(&finger.ahead).max(0.0) * ahead_widths * finger.half_width_px;
            let outer_px = (REACH_PX + ahead_px).min(MOST_REACH_PX);
            let inside = SidedPixel::along(*position, -normal, EDGE_PX, depth_px, true);
            self.pixels.extend(inside);
            let outside = SidedPixel::along(*position, *normal, 2.0 * EDGE_PX, outer_px, false);
            self.pixels.extend(outside);
        }
    }
}

// What is taught is private to the tracker, and what it must agree with is what was painted.
#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::super::convergence::UNSEEN_FRAMES;
    use super::*;
    use crate::frame::ColourView;
    use crate::image::GrayView;

    const SIDE: usize = 80;
    /// The hand ends here, before paper above and before something else below \[px\].
    const EDGE: f64 = 40.0;
    const SKIN: [f64; 3] = [124.0, 139.0, 175.0];
    const PAPER: [f64; 3] = [191.0, 184.0, 178.0];
    const WOOD: [f64; 3] = [104.0, 124.0, 141.0];
    const BLUE: [f64; 3] = [170.0, 90.0, 60.0];

    /// For how long the paper was seen, and how long that is remembered.
    const SEEN_FRAMES: usize = 30;
    const KEEP: f64 = 0.8;

    /// Looks of a hand that was seen before paper for long, after a frame in which its lower half shows
    /// no edge: what that half is of, and what is behind it.
    fn taught(inside: [f64; 3], behind: [f64; 3]) -> [Looks; 2] {
        let colour_at = |i: usize| {
            let (x, y) = (i % SIDE, i / SIDE);
            let below = 2 * y >= SIDE;
            let colour = match (x < EDGE as usize, below) {
                (true, false) => SKIN,
                (true, true) => inside,
                (false, false) => PAPER,
                (false, true) => behind,
            };
            // Shades are many, and noise is of every channel's own.
            let shade = 1.0 - 0.03 * ((3 * x + 7 * y) % 11) as f64;
            let noise = |k: usize| ((5 * x + 3 * y + 4 * k * (x + 1)) % 7) as f64 - 3.0;
            [0, 1, 2].map(|k| (shade * colour[k] + noise(k)) as u8)
        };
        let colours: Vec<[u8; 3]> = (0..SIDE * SIDE).map(colour_at).collect();
        let greys: Vec<u8> = colours.iter().map(|[_, g, _]| *g).collect();
        let gray = GrayView::new(&greys, SIDE, SIDE, SIDE).unwrap();
        let colour = ColourView::new(colours.as_flattened(), SIDE, SIDE, 3 * SIDE).unwrap();
        let frame = Frame::coloured(gray, colour).unwrap();
        let at = |y: usize| PlacedSample {
            position: Point2::new(EDGE - 0.5, y as f64),
            normal: Vector2::x(),
        };
        let edges: Vec<_> = (4..SIDE / 2 - 2).map(at).collect();
        let unseen: Vec<_> = (SIDE / 2 + 2..SIDE - 4).map(at).collect();
        let finger = Silhouette { ahead: Vector2::y(), half_width_px: 8.0 };
        let mut image = DiscriminantImage::default();
        let mut before = Looks::new(true);
        let contour = Contour { edges: &edges, unseen: &[] };
        for _ in 0..SEEN_FRAMES {
            before.learn(&frame, &mut image, &contour, &finger, (KEEP, 1.0)).unwrap();
        }
        let mut after = before.clone();
        let contour = Contour { edges: &[], unseen: &unseen };
        after.learn(&frame, &mut image, &contour, &finger, (1.0, UNSEEN_FRAMES)).unwrap();
        [before, after]
    }

    /// How much brighter skin is than wood as a mixture shows them \[grey levels\].
    fn contrast(looks: &Looks) -> f64 {
        let colours = [SKIN, WOOD].map(|colour| colour.map(|c| c as u8));
        let gray = GrayView::new(&[0; 2], 2, 1, 2).unwrap();
        let colour = ColourView::new(colours.as_flattened(), 2, 1, 6).unwrap();
        let frame = Frame::coloured(gray, colour).unwrap();
        let mut image = DiscriminantImage::default();
        let mixture = looks.discriminant.mixture().unwrap();
        let shown = image.of(&frame, mixture, [0.0, 2.0, 0.0, 1.0]).unwrap();
        let [skin, wood] = [0, 1].map(|x| f64::from(shown.image().pixel(x, 0).unwrap()));
        skin - wood
    }

    #[test]
    fn what_is_behind_a_hand_is_learned_where_no_edge_shows_it() {
        let [before, after] = taught(SKIN, WOOD);
        // Half of the least contrast of a hand is that of an edge that counts.
        assert!(contrast(&before) < 9.0, "{}", contrast(&before));
        assert!(contrast(&after) >= 17.0, "{}", contrast(&after));
        assert!(after.plain.separation() > 2.0);
    }

    #[test]
    fn a_hand_behind_it_and_what_covers_it_teach_nothing() {
        for (inside, behind) in [(SKIN, SKIN), (BLUE, WOOD), (BLUE, BLUE)] {
            let [before, after] = taught(inside, behind);
            assert_eq!(after.discriminant.mixture(), before.discriminant.mixture());
            assert_eq!(after.plain, before.plain);
        }
    }
}
