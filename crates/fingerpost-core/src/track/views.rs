//! Update of every view of a rig by one frame each, in one call.
//!
//! Views share no state, so they can be updated in parallel threads; the tracks are identical to
//! the bit. Starting and joining a thread costs some tens of microseconds, and more if the
//! processor is busy. That is little for a view that searches for its hand, which takes
//! milliseconds, and about as much as a thread saves for a view that tracks one.

use crate::Result;
use crate::appearance::background::Background;
use crate::image::frame::Frame;
use crate::track::{ContourTracker, Status, Track};
use std::thread;

/// One view's update: its tracker and its newest frame.
#[derive(Debug)]
pub struct ViewUpdate<'a> {
    /// The tracker of this view.
    pub tracker: &'a mut ContourTracker,
    /// The view's frame.
    pub frame: Frame<'a>,
    /// The view's background model, if it is known; it must have looked at the frame.
    pub background: Option<&'a Background>,
    /// Time of capture \[s\].
    pub time_s: f64,
}

/// Distribution of the updates over threads.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Schedule {
    /// Views that track a hand in the calling thread, each of the others in a thread of its own.
    #[default]
    ByNeed,
    /// All views in the calling thread, one after the other.
    InTurn,
    /// A thread for each view.
    SideBySide,
}

/// Updates the tracker of every view and returns the tracks in the order of the views. An error of
/// one view ([`ContourTracker::update_before`] lists them) leaves the others' tracks intact. If the
/// system starts no more threads, the calling one does the work.
///
/// ```
/// use fingerpost_core::nalgebra::Point2;
/// use fingerpost_core::{ContourTracker, Frame, GrayView, StartPose, Status, Template, Thumb};
/// use fingerpost_core::{Schedule, ViewUpdate, update_views};
///
/// let start = StartPose { tip_px: Point2::new(90.0, 60.0), angle_rad: 0.5, length_px: 50.0 };
/// let tracker = ContourTracker::new(Template::pistol(Thumb::None)?, &start, Default::default())?;
/// let (mut left, mut right) = (tracker.clone(), tracker);
/// let pixels = vec![70; 160 * 120];
/// let frame = Frame::gray(GrayView::new(&pixels, 160, 120, 160)?);
/// let updates = vec![
///     ViewUpdate { tracker: &mut left, frame, background: None, time_s: 0.0 },
///     ViewUpdate { tracker: &mut right, frame, background: None, time_s: f64::NAN },
/// ];
/// let tracks = update_views(updates, Schedule::ByNeed);
/// assert!(tracks[0].as_ref().is_ok_and(|track| track.status == Status::Acquiring));
/// assert!(tracks[1].is_err());
/// # Ok::<(), fingerpost_core::Error>(())
/// ```
pub fn update_views(updates: Vec<ViewUpdate<'_>>, schedule: Schedule) -> Vec<Result<Track>> {
    let mut shares: Vec<_> = updates.into_iter().map(Share::of).collect();
    let (mut in_threads, mut in_turn): (Vec<_>, Vec<_>) =
        shares.iter_mut().partition(|share| share.needs_thread(schedule));
    if in_turn.is_empty() {
        in_turn.extend(in_threads.pop());
    }
    thread::scope(|scope| {
        for share in in_threads {
            // An update without a thread is unchanged, and is done below.
            let _ = thread::Builder::new().spawn_scoped(scope, || share.finish());
        }
        in_turn.into_iter().for_each(Share::finish);
    });
    shares.iter_mut().for_each(Share::finish);
    shares.into_iter().filter_map(|share| share.track).collect()
}

/// One view's update, pending or done.
struct Share<'a> {
    update: Option<ViewUpdate<'a>>,
    track: Option<Result<Track>>,
}

impl<'a> Share<'a> {
    fn of(update: ViewUpdate<'a>) -> Self {
        Self { update: Some(update), track: None }
    }

    /// Whether a thread of its own saves time.
    fn needs_thread(&self, schedule: Schedule) -> bool {
        match schedule {
            Schedule::InTurn => false,
            Schedule::SideBySide => true,
            Schedule::ByNeed => {
                self.update.as_ref().is_some_and(|u| u.tracker.status() != Status::Tracking)
            }
        }
    }

    fn finish(&mut self) {
        if let Some(ViewUpdate { tracker, frame, background, time_s }) = self.update.take() {
            self.track = Some(match background {
                Some(known) => tracker.update_before(&frame, known, time_s),
                None => tracker.update(&frame, time_s),
            });
        }
    }
}
