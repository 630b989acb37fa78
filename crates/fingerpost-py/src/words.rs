//! The core's enums are words in Python.

use crate::errors::wrong;
use fingerpost_core::geometry::contour::HandSide;
use fingerpost_core::geometry::template::Thumb;
use fingerpost_core::measure::edge::{Miss, Polarity, Scale};
use fingerpost_core::solve::fit::{Outcome, Solve};
use fingerpost_core::track::views::Schedule;
use fingerpost_core::track::{LineSource, Model, Refusal, Status};
use pyo3::prelude::*;
use pyo3::types::PyString;

/// An enum whose values are words in Python.
pub trait Word: Copy + 'static {
    /// All values.
    const ALL: &'static [Self];

    /// The word of this value.
    fn word(self) -> &'static str;

    /// The value of a word, or the error that names all words.
    fn parse(value: &Bound<'_, PyAny>, what: &str) -> PyResult<Self> {
        let given = value.cast::<PyString>().ok();
        let meant = |choice: &&Self| given.is_some_and(|word| word == choice.word());
        Self::ALL.iter().find(meant).copied().ok_or_else(|| {
            let mut words: Vec<_> = Self::ALL.iter().map(|c| format!("{:?}", c.word())).collect();
            let last = words.pop().unwrap_or_default();
            wrong(what, value, &format!("{} or {last}", words.join(", ")))
        })
    }
}

macro_rules! words {
    ($($choice:ident { $($value:ident = $word:literal),+ $(,)? })+) => {
        $(impl Word for $choice {
            const ALL: &'static [Self] = &[$(Self::$value),+];

            fn word(self) -> &'static str {
                match self {
                    $(Self::$value => $word,)+
                }
            }
        })+
    };
}

words! {
    HandSide { Left = "left", Right = "right" }
    Thumb { Left = "left", Right = "right", None = "none" }
    Polarity { Bright = "bright", Dark = "dark", Unknown = "unknown" }
    Miss { OutOfImage = "out-of-image", NoContrast = "no-contrast", BeyondEnd = "beyond-end" }
    Scale { Fine = "fine", Coarse = "coarse" }
    Solve { Joint = "joint", TwoStage = "two-stage" }
    Outcome {
        Determined = "determined",
        TooFewEquations = "too-few-equations",
        Undetermined = "undetermined",
    }
    LineSource { Contour = "contour", Pixels = "pixels", Both = "both" }
    Model { Ribbon = "ribbon", Paper = "paper" }
    Refusal {
        NoFit = "no-fit",
        Size = "size",
        Motion = "motion",
        Agreement = "agreement",
        Residual = "residual",
        Background = "background",
        Misfit = "misfit",
    }
    Schedule { ByNeed = "by-need", InTurn = "in-turn", SideBySide = "side-by-side" }
    Status { Acquiring = "acquiring", Tracking = "tracking", Lost = "lost" }
}
