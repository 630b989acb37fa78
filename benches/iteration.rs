//! The timed work: one iteration of the contour, and a tracker that follows a hand.

use crate::{Scene, first_frames};
use fingerpost_core::geometry::planar::{Affine, AffineMap, PlanarSpace};
use fingerpost_core::geometry::shape_space::{Pose, ShapeSpace};
use fingerpost_core::geometry::template::{Template, TemplateSample, Thumb};
use fingerpost_core::measure::edge::{EdgeMeasurement, Polarity, Scale, SearchLine};
use fingerpost_core::measure::edge_search::{Cue, EdgeSearch, SearchOptions};
use fingerpost_core::nalgebra::SVector;
use fingerpost_core::numeric::simd::Isa;
use fingerpost_core::solve::fit::{EquationBuffer, FitOptions, Fitter, Outcome};
use fingerpost_core::track::{ContourTracker, Model, Status, TrackerOptions};
use fingerpost_core::{Frame, GrayView};
use std::time::Instant;

/// Place, search and fit in the affine shape space, with all buffers.
pub struct Iteration {
    samples: Vec<TemplateSample>,
    half_length_px: f64,
    search: EdgeSearch,
    fitter: Fitter,
    equations: EquationBuffer,
    lines: Vec<SearchLine>,
    found: Vec<EdgeMeasurement>,
}

impl Iteration {
    /// Lines of ± `half_length_px` at `samples`; the kernel's scale, or the default one.
    #[must_use]
    pub fn new(
        isa: Isa,
        samples: Vec<TemplateSample>,
        half_length_px: f64,
        scale_px: Option<f64>,
    ) -> Self {
        let options = SearchOptions::default();
        let options = SearchOptions { scale_px: scale_px.unwrap_or(options.scale_px), ..options };
        Self {
            search: EdgeSearch::new(options).unwrap().with_isa(isa),
            fitter: Fitter::new(FitOptions::default()).unwrap().with_isa(isa),
            equations: EquationBuffer::with_capacity(samples.len(), 6),
            lines: Vec::with_capacity(samples.len()),
            found: Vec::with_capacity(samples.len()),
            samples,
            half_length_px,
        }
    }

    /// Places the lines.
    pub fn place(&mut self, map: &AffineMap) {
        let half_length_px = self.half_length_px;
        self.lines.clear();
        self.lines.extend(self.samples.iter().map(|sample| SearchLine {
            sample: map.place(sample),
            half_length_px,
            polarity: Polarity::Bright,
        }));
    }

    /// Searches along them.
    pub fn search(&mut self, frame: &Frame<'_>) {
        let Self { search, lines, found, .. } = self;
        search.search(frame, Cue::Edges, Scale::Fine, lines, found).unwrap();
    }

    /// Fits the map to the measurements.
    pub fn fit(&mut self, map: &AffineMap) -> SVector<f64, 6> {
        let (space, x) = Affine::through(map).unwrap();
        let mut equations = self.equations.clear::<6>();
        for ((sample, line), found) in self.samples.iter().zip(&self.lines).zip(&self.found) {
            if let Ok(edge) = found {
                let row = space.normal_row(map, sample, &line.sample.normal);
                equations.push(&row, edge.offset_px, edge.variance_px2).unwrap();
            }
        }
        let report = self.fitter.solve(&equations, None);
        assert_eq!(report.outcome, Outcome::Determined, "the finger is not found");
        x + report.step
    }

    /// One iteration; returns the new map.
    pub fn run(&mut self, frame: &Frame<'_>, map: &AffineMap) -> AffineMap {
        self.place(map);
        self.search(frame);
        Affine.pose(&self.fit(map))
    }

    /// The time of one iteration \[µs\].
    pub fn time_us(&mut self, frame: &Frame<'_>, map: &AffineMap) -> f64 {
        let start = Instant::now();
        std::hint::black_box(self.run(frame, map));
        start.elapsed().as_secs_f64() * 1e6
    }
}

/// Frames of the hand's closed path.
const FRAMES: usize = 64;

/// A tracker that has acquired the hand of a scene.
pub struct Tracked {
    tracker: ContourTracker,
    scenes: Vec<Scene>,
    time_s: f64,
}

impl Tracked {
    /// Both models, by name.
    #[must_use]
    pub fn all() -> [(&'static str, Self); 2] {
        [("paper's model", Model::Paper), ("band model", Model::Ribbon)]
            .map(|(name, model)| (name, Self::new(model, FRAMES)))
    }

    /// A tracker that has acquired the hand, for the first `count` frames of its path.
    #[must_use]
    pub fn new(model: Model, count: usize) -> Self {
        let scenes = first_frames([640, 480], count, FRAMES);
        let options = TrackerOptions { model, ..TrackerOptions::default() };
        let template = Template::pistol(Thumb::Right).unwrap();
        let tracker = ContourTracker::new(template, &scenes[0].pose, options).unwrap();
        let mut tracked = Self { tracker, scenes, time_s: 0.0 };
        let status = (0..10).map(|_| tracked.update(0)).last();
        assert_eq!(status, Some(Status::Tracking), "the hand is not acquired");
        tracked
    }

    /// Updates the tracker by frame `i`, modulo their number; with all frames, the path is closed.
    pub fn update(&mut self, i: usize) -> Status {
        let Scene { pixels, size: [width, height], .. } = &self.scenes[i % self.scenes.len()];
        let image = GrayView::new(pixels, *width, *height, *width).unwrap();
        self.time_s += 0.04;
        self.tracker.update(&Frame::gray(image), self.time_s).unwrap().status
    }

    /// The median time of a frame \[µs\].
    pub fn update_us(&mut self) -> f64 {
        let times = (0..4 * self.scenes.len()).map(|i| {
            let start = Instant::now();
            let status = self.update(i);
            assert_eq!(status, Status::Tracking, "the hand is lost");
            start.elapsed().as_secs_f64() * 1e6
        });
        median(&mut times.collect::<Vec<_>>())
    }
}

/// The median of some numbers.
///
/// # Panics
/// When there are none.
#[must_use]
pub fn median(numbers: &mut [f64]) -> f64 {
    let middle = numbers.len() / 2;
    *numbers.select_nth_unstable_by(middle, f64::total_cmp).1
}
