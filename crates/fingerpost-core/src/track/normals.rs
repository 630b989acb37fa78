//! Search lines along the normals of a placed contour, and the edges measured on them.

use super::appearance::{GreyCue, SearchModel};
use super::options::TrackerOptions;
use super::pyramid::PyramidLevel;
use super::scene::{Scene, SceneBackground};
use crate::Result;
use crate::appearance::discriminant::region_about;
use crate::appearance::histogram::INSIDE_PX;
use crate::geometry::shape_space::PlacedSample;
use crate::geometry::template::Part;
use crate::image::frame::Frame;
use crate::measure::edge::{Edge, EdgeMeasurement, Miss, Scale, SearchLine};
use crate::measure::edge_search::{Cue, EdgeSearch};
use crate::numeric::simd::Isa;

/// Least distance from an edge, and from the end of a search line, within which the image in a
/// search model's mixture is computed \[px\]: appearance is sampled up to 8 px from an edge, and a
/// finger is refined by edges up to 12 px from its flanks.
pub(super) const SURROUNDINGS_PX: f64 = 32.0;
/// Least ratio of contrasts with which an edge of the grey image replaces one of a mixture of
/// colours further inside.
const PLAINER: f64 = 2.0;
/// Mean foreground probability of the pixels [`INSIDE_PX`] of an edge below which the edge is the
/// background's.
const HARDLY: f64 = 0.3;
/// Half-length of the second search, about the place where the line leaves the foreground \[px\].
const BEGINS_WITHIN_PX: f64 = 4.0;

/// The lines of one search, in the order of insertion, and its buffers.
#[derive(Debug, Clone)]
pub(super) struct Normals {
    search: EdgeSearch,
    lines: Vec<SearchLine>,
    /// The part of the outline of each line.
    parts: Vec<Part>,
    found: Vec<EdgeMeasurement>,
    /// Edges on the lines of one part.
    found_of_part: Vec<EdgeMeasurement>,
    /// Which edges are those of the grey image, if another is searched.
    in_grey: Vec<bool>,
    grey_lines: Vec<SearchLine>,
    found_in_grey: Vec<EdgeMeasurement>,
    /// Lines of the second search, their parts, and the lines they replace.
    again: Vec<SearchLine>,
    again_parts: Vec<Part>,
    replaced: Vec<Replaced>,
    found_again: Vec<EdgeMeasurement>,
}

/// A line whose edge is the background's.
#[derive(Debug, Clone, Copy)]
struct Replaced {
    line: usize,
    /// Position along it where the foreground ends \[px\].
    begins_px: f64,
}

impl Normals {
    pub fn new(options: &TrackerOptions) -> Result<Self> {
        Ok(Self {
            search: EdgeSearch::new(options.search)?,
            lines: Vec::with_capacity(options.samples),
            parts: Vec::with_capacity(options.samples),
            found: Vec::with_capacity(options.samples),
            found_of_part: Vec::with_capacity(options.samples),
            in_grey: Vec::with_capacity(options.samples),
            grey_lines: Vec::with_capacity(options.samples),
            found_in_grey: Vec::with_capacity(options.samples),
            again: Vec::with_capacity(options.samples),
            again_parts: Vec::with_capacity(options.samples),
            replaced: Vec::with_capacity(options.samples),
            found_again: Vec::with_capacity(options.samples),
        })
    }

    /// The same with another instruction set.
    pub fn with_isa(self, isa: Isa) -> Self {
        Self { search: self.search.with_isa(isa), ..self }
    }

    pub fn clear(&mut self) {
        self.lines.clear();
        self.parts.clear();
    }

    /// Adds a line of a part of the outline.
    pub fn push(&mut self, part: Part, line: SearchLine) {
        self.lines.push(line);
        self.parts.push(part);
    }

    pub fn lines(&self) -> &[SearchLine] {
        &self.lines
    }

    /// The measurement of each line.
    pub fn found(&self) -> &[EdgeMeasurement] {
        &self.found
    }

    /// Converts a search in a reduced image to pixels of its frame.
    pub fn enlarge(&mut self, pyramid_level: PyramidLevel) {
        let px = pyramid_level.px();
        for (line, found) in self.lines.iter_mut().zip(&mut self.found) {
            line.sample = pyramid_level.sample(&line.sample);
            line.half_length_px *= px;
            if let Ok(edge) = found {
                edge.offset_px *= px;
                edge.variance_px2 *= px * px;
            }
        }
    }

    /// The region that the search of the lines reads: first and last column, first and last row
    /// \[px\].
    pub fn region(&self) -> [f64; 4] {
        // The second search extends beyond the end of a line that leaves the foreground there.
        let beyond_px = SURROUNDINGS_PX.max(BEGINS_WITHIN_PX + self.search.reach_px());
        let reach = |line: &SearchLine| line.half_length_px + beyond_px;
        region_about(self.lines.iter().map(|line| (line.sample.position, reach(line))))
    }

    /// Searches every line of a scene; `search_frame` is its frame in the search model's mixture.
    /// Edges that the background explains are dropped; with `matched_only`, so are edges that do
    /// not match the appearance model inside.
    pub fn search(
        &mut self,
        scene: &Scene<'_>,
        search_frame: &Frame<'_>,
        search_model: &SearchModel<'_>,
        scale: Scale,
        matched_only: bool,
    ) -> Result<()> {
        let lines = (self.lines.as_slice(), self.parts.as_slice());
        let (of_part, found) = (&mut self.found_of_part, &mut self.found);
        search_parts(&mut self.search, search_frame, search_model, scale, lines, of_part, found)?;
        self.in_grey.clear();
        self.in_grey.resize(self.lines.len(), false);
        if let Some(in_grey) = &search_model.in_grey {
            self.search_in_grey(scene, search_model, in_grey, scale)?;
        }
        if matched_only {
            for line in 0..self.lines.len() {
                if self.found[line].is_ok()
                    && !self.matches_appearance(line, scene, search_frame, search_model)
                {
                    self.found[line] = Err(Miss::NoContrast);
                }
            }
        }
        match scene.background_for_search() {
            Some(background) if !matches!(search_model.cue, Cue::LogRatio(_)) => {
                self.search_before(background, search_frame, search_model, scale)
            }
            _ => Ok(()),
        }
    }

    /// A mixture of colours that shows most of a hand best may hardly show some of its edges, or
    /// show objects inside of them better. The hand's own edge in grey is used where it is the only
    /// one, or lies further out with much more contrast. For a finger lit from one side it is used
    /// on the lit flank, and not on the shaded one.
    fn search_in_grey(
        &mut self,
        scene: &Scene<'_>,
        search_model: &SearchModel<'_>,
        in_grey: &GreyCue<'_>,
        scale: Scale,
    ) -> Result<()> {
        let polarity = in_grey.polarity;
        self.grey_lines.clear();
        self.grey_lines.extend(self.lines.iter().map(|line| SearchLine { polarity, ..*line }));
        let (lines, grey) = (&self.grey_lines, &mut self.found_in_grey);
        self.search.search(scene, Cue::Edges, scale, lines, grey)?;
        let found = self.found.iter_mut().zip(&mut self.in_grey).zip(&self.parts);
        for ((line, grey), ((found, in_place), part)) in lines.iter().zip(grey).zip(found) {
            let Ok(edge) = grey else { continue };
            let is_known = match in_grey.shaded {
                Some(shaded) if part.is_flank() => *part == shaded,
                _ => found.is_ok_and(|other| !is_plainer(edge, &other)),
            };
            if is_known {
                continue;
            }
            if search_model.matches_in_grey(in_grey, scene, &at_edge(line, edge)) {
                (*found, *in_place) = (*grey, true);
            }
        }
        Ok(())
    }

    /// Whether the edge of a line matches the appearance model inside; `search_frame` is the frame
    /// in the search model's mixture.
    pub fn matches_appearance(
        &self,
        line: usize,
        frame: &Frame<'_>,
        search_frame: &Frame<'_>,
        search_model: &SearchModel<'_>,
    ) -> bool {
        let Ok(edge) = &self.found[line] else { return false };
        let edge = at_edge(&self.lines[line], edge);
        match &search_model.in_grey {
            Some(in_grey) if self.in_grey[line] => {
                search_model.matches_in_grey(in_grey, frame, &edge)
            }
            _ => search_model.matches_appearance_on(self.parts[line], frame, search_frame, &edge),
        }
    }

    /// Drops edges that the background explains. Where the line leaves the foreground, the hand's
    /// own edge is searched again.
    fn search_before(
        &mut self,
        background: SceneBackground<'_>,
        search_frame: &Frame<'_>,
        search_model: &SearchModel<'_>,
        scale: Scale,
    ) -> Result<()> {
        self.again.clear();
        self.again_parts.clear();
        self.replaced.clear();
        for (i, (line, found)) in self.lines.iter().zip(&mut self.found).enumerate() {
            let Ok(edge) = found else { continue };
            if !is_background(background, line, edge.offset_px) {
                continue;
            }
            *found = Err(Miss::NoContrast);
            if let Some(begins_px) = where_hand_begins(background, line) {
                let sample = PlacedSample {
                    position: line.sample.position + line.sample.normal * begins_px,
                    ..line.sample
                };
                self.again.push(SearchLine { sample, half_length_px: BEGINS_WITHIN_PX, ..*line });
                self.again_parts.push(self.parts[i]);
                self.replaced.push(Replaced { line: i, begins_px });
            }
        }
        let lines = (self.again.as_slice(), self.again_parts.as_slice());
        let (of_part, found) = (&mut self.found_of_part, &mut self.found_again);
        search_parts(&mut self.search, search_frame, search_model, scale, lines, of_part, found)?;
        for (&Replaced { line, begins_px }, found) in self.replaced.iter().zip(&self.found_again) {
            let Ok(mut edge) = *found else { continue };
            edge.offset_px += begins_px;
            if !is_background(background, &self.lines[line], edge.offset_px) {
                self.found[line] = Ok(edge);
                self.in_grey[line] = false;
            }
        }
        Ok(())
    }
}

/// Searches lines with the cue of their part of the outline, where flanks are known separately;
/// `of_part` is a buffer.
fn search_parts(
    search: &mut EdgeSearch,
    search_frame: &Frame<'_>,
    search_model: &SearchModel<'_>,
    scale: Scale,
    (lines, parts): (&[SearchLine], &[Part]),
    of_part: &mut Vec<EdgeMeasurement>,
    found: &mut Vec<EdgeMeasurement>,
) -> Result<()> {
    if search_model.flank_levels.is_none() {
        return search.search(search_frame, search_model.cue, scale, lines, found);
    }
    found.clear();
    for same in parts.chunk_by(|one, next| one == next) {
        let Some(&part) = same.first() else { continue };
        let lines = &lines[found.len()..][..same.len()];
        search.search(search_frame, search_model.cue_of(part), scale, lines, of_part)?;
        found.append(of_part);
    }
    Ok(())
}

/// Whether an edge of the grey image lies further out than another, with [`PLAINER`] times its
/// contrast.
fn is_plainer(edge: &Edge, other: &Edge) -> bool {
    edge.offset_px > other.offset_px
        && edge.contrast_grey.abs() >= PLAINER * other.contrast_grey.abs()
}

/// A sample of the contour moved to its edge.
pub(super) fn at_edge(line: &SearchLine, edge: &Edge) -> PlacedSample {
    let PlacedSample { position, normal } = line.sample;
    PlacedSample { position: position + normal * edge.offset_px, normal }
}

/// Foreground probability at a position on a search line; `None` if unknown.
fn foreground(background: SceneBackground<'_>, line: &SearchLine, at: f64) -> Option<f64> {
    background.foreground(line.sample.position + line.sample.normal * at)
}

/// Whether the pixels inside of an edge are background; false if that is unknown.
fn is_background(background: SceneBackground<'_>, line: &SearchLine, offset_px: f64) -> bool {
    let (mut sum, mut count) = (0.0, 0.0);
    for inside_px in INSIDE_PX {
        if let Some(likely) = foreground(background, line, offset_px - inside_px) {
            sum += likely;
            count += 1.0;
        }
    }
    sum < HARDLY * count
}

/// Position along a line where foreground ends and background begins, from inside outwards, by the
/// best change point; `None` without both.
fn where_hand_begins(background: SceneBackground<'_>, line: &SearchLine) -> Option<f64> {
    let reach = line.half_length_px.floor();
    let (mut sum, mut best, mut begins_px) = (0.0, 0.0, None);
    let mut at = -reach;
    while at <= reach {
        sum += foreground(background, line, at).map_or(0.0, |likely| likely - 0.5);
        if sum > best && at < reach {
            (best, begins_px) = (sum, Some(at + 0.5));
        }
        at += 1.0;
    }
    begins_px
}

/// A line of the last search, and its measurement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SearchedLine<'a> {
    /// The line that was searched.
    pub line: &'a SearchLine,
    /// The edge, or the reason why there is none.
    pub found: &'a EdgeMeasurement,
    /// Whether the edge agrees with the fit, that is, counts among
    /// [`Diagnostics::inliers`](super::Diagnostics::inliers).
    pub agrees: bool,
}

// The region is private to the crate; what the search reads shows in its measurements.
#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;
    use crate::image::gray::GrayView;
    use crate::measure::edge::Polarity;
    use crate::measure::edge_search::SearchOptions;
    use nalgebra::{Point2, Vector2};

    const SIZE: [usize; 2] = [400, 200];

    #[test]
    fn the_search_reads_no_pixel_outside_of_its_region() {
        for (scale_px, scale) in [0.5, 1.6, 4.0, 8.0]
            .into_iter()
            .flat_map(|px| [Scale::Fine, Scale::Coarse].map(|scale| (px, scale)))
        {
            let search = SearchOptions { scale_px, ..SearchOptions::default() };
            let mut normals =
                Normals::new(&TrackerOptions { search, ..TrackerOptions::default() }).unwrap();
            let sample = PlacedSample { position: Point2::new(200.0, 100.0), normal: Vector2::x() };
            let line = SearchLine { sample, half_length_px: 20.0, polarity: Polarity::Unknown };
            normals.push(Part::Tip, line);
            let [left, right, ..] = normals.region();
            let mut found = |level: &dyn Fn(f64) -> u8| {
                let columns: Vec<u8> = (0..SIZE[0]).map(|u| level(u as f64)).collect();
                let pixels = columns.repeat(SIZE[1]);
                let image = GrayView::new(&pixels, SIZE[0], SIZE[1], SIZE[0]).unwrap();
                let frame = Frame::gray(image);
                let search_model = SearchModel::unknown(Polarity::Unknown);
                let scene = Scene::new(&frame, None);
                normals.search(&scene, &frame, &search_model, scale, false).unwrap();
                normals.found()[0]
            };
            let step = |u: f64| if u < 203.0 { 150 } else { 50 };
            let known = found(&step);
            assert!(known.is_ok());
            for stale in [0, 255] {
                let is_inside = |u: f64| (left.floor()..=right.ceil()).contains(&u);
                let shown = found(&|u| if is_inside(u) { step(u) } else { stale });
                assert_eq!(shown, known, "{scale_px} px {scale:?}");
            }
        }
    }
}
