//! The template: a B-spline outline of the pointing hand with its pointing axis.
//!
//! Template coordinates (p, q): the origin is the middle of the visible index finger, p runs along
//! its axis towards the tip, q to the right of the pointing direction in the image (u right, v
//! down). The visible finger has unit length: its axis runs from p = −½ at the knuckle to p = +½ at
//! the apex. A pose is therefore given by a tip, a direction and a length in pixels. The axis is
//! the basis vector of p, so the first column of the fitted map *is* the pointing direction
//! (Cipolla, Hadfield & Hollinghurst 1994, section 3.2 and figure 3).
//!
//! The pistol is an index finger and a thumb, each a band with a round end. The outline runs up the
//! finger's outer flank, round the tip, down to the crotch (a corner: a triple knot of the cubic
//! spline) and round the thumb. The rest of the hand is left out, because it differs between
//! persons.

use super::bspline::{BSpline, Degree, Parametrization, check_count};
use super::contour::{ContourSample, HandSide};
use crate::geometry::contour;
use crate::{Error, Result};
use nalgebra::{Point2, SVector, Vector2};
use std::f64::consts::{FRAC_PI_2, PI};

/// Half the visible finger: its axis runs from −½ to +½.
pub const HALF_LENGTH: f64 = 0.5;

/// Side of the thumb, seen along the pointing direction in the image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Thumb {
    /// Left of the finger.
    Left,
    /// Right of the finger.
    Right,
    /// No thumb: the template is the finger alone.
    None,
}

/// The thumb of a pistol. Lengths are in units of the visible index finger.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ThumbProportions {
    /// p of the intersection of the thumb's axis with the finger's, −1 to 0.5.
    pub base: f64,
    /// Angle between the two axes \[rad\], 0.5 to 2.
    pub angle_rad: f64,
    /// Length of the thumb's axis from the intersection to its apex, 0.3 to 2.
    pub length: f64,
    /// Half-width of the thumb, 0.03 to 0.4.
    pub half_width: f64,
    /// Fraction of the thumb's far flank that the outline follows back from the tip, 0 to 1.
    pub far_flank: f64,
}

/// The shape of a pistol or of a finger alone. Lengths are in units of the visible index finger.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Proportions {
    /// Half-width of the finger, 0.03 to 0.4.
    pub half_width: f64,
    /// Start of the outline on the finger's flank, p from −0.5 to 0.3; nearer to the knuckle the
    /// folded fingers occlude the flank.
    pub flank_start: f64,
    /// The thumb, and its side; a finger alone has none.
    pub thumb: Option<(HandSide, ThumbProportions)>,
}

/// Half-width of the usual finger, in visible lengths.
pub(crate) const USUAL_HALF_WIDTH: f64 = 0.115;

impl Proportions {
    /// The usual hand.
    #[must_use]
    pub fn usual(thumb: Thumb) -> Self {
        let side = match thumb {
            Thumb::Left => Some(HandSide::Left),
            Thumb::Right => Some(HandSide::Right),
            Thumb::None => None,
        };
        let thumb = ThumbProportions {
            base: -0.5,
            angle_rad: 75.0_f64.to_radians(),
            length: 0.8,
            half_width: 0.1,
            far_flank: 0.6,
        };
        Self {
            half_width: USUAL_HALF_WIDTH,
            flank_start: -0.35,
            thumb: side.map(|side| (side, thumb)),
        }
    }
}

/// The two limbs of a pistol.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Limb {
    /// The index finger; all of a traced outline counts as finger.
    Finger,
    /// The thumb.
    Thumb,
}

/// A sample of the template's outline.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TemplateSample {
    /// (p, q).
    pub position: Point2<f64>,
    /// Unit normal in template coordinates, out of the hand.
    pub normal: Vector2<f64>,
    /// The limb it lies on.
    pub limb: Limb,
    /// Foot of its normal on the limb's spine: p on the finger; on the thumb the fraction of the
    /// distance from its root to the centre of its round tip.
    pub along: f64,
    /// The unit normal in the limb's own axes: along it, and across it. Across the finger is q;
    /// across the thumb is towards the fingertip.
    pub radial: Vector2<f64>,
}

/// Parts of a hand's outline with different functions: the flanks determine the line, and tip and
/// thumb the position along it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// The finger's flank on the left of the pointing direction.
    LeftFlank,
    /// The one on the right.
    RightFlank,
    /// The finger's round end.
    Tip,
    /// All of the thumb.
    Thumb,
}

impl Part {
    /// Whether it is one of the finger's two flanks.
    #[must_use]
    pub fn is_flank(self) -> bool {
        matches!(self, Self::LeftFlank | Self::RightFlank)
    }
}

impl TemplateSample {
    /// The part of the outline that the sample belongs to.
    #[must_use]
    pub fn part(&self) -> Part {
        match self.limb {
            Limb::Thumb => Part::Thumb,
            Limb::Finger if self.radial.x > 0.5 => Part::Tip,
            Limb::Finger if self.radial.y < 0.0 => Part::LeftFlank,
            Limb::Finger => Part::RightFlank,
        }
    }
}

/// The B-spline rest shape of the pointing hand, in template coordinates.
#[derive(Debug, Clone, PartialEq)]
pub struct Template {
    spline: BSpline,
    control_points: Vec<Point2<f64>>,
    hand: HandSide,
    thumb: Thumb,
    /// The parameter where the outline passes from the finger to the thumb, if it has one.
    crotch: Option<f64>,
    /// The proportions of a pistol; `None` for a traced outline.
    proportions: Option<Proportions>,
}

/// Length of outline per control point of a pistol, in finger lengths, and its upper bound in
/// half-widths of the slimmer limb. Each round tip has about four knots, and the spline stays
/// within 0.002 of it.
const KNOT_STEP: f64 = 0.08;
const KNOT_STEP_IN_HALF_WIDTHS: f64 = 0.8;
/// Number of control points that follow a traced outline of finger and thumb but not its pixel
/// noise: about a dozen round each limb. A default for [`Template::from_outline`].
pub const TRACED_CONTROL_POINTS: usize = 24;
/// Outline points per control point of the least-squares fit.
const POINTS_PER_CONTROL_POINT: usize = 8;

impl Template {
    /// Index finger and up-turned thumb of the usual hand; the finger alone for [`Thumb::None`].
    ///
    /// # Errors
    /// None for these proportions; the signature is that of
    /// [`with_proportions`](Self::with_proportions).
    ///
    /// ```
    /// use fingerpost_core::{Template, Thumb};
    ///
    /// let template = Template::pistol(Thumb::Left)?;
    /// assert!(template.samples(100)?.iter().any(|s| s.position.y < -0.5));
    /// # Ok::<(), fingerpost_core::Error>(())
    /// ```
    pub fn pistol(thumb: Thumb) -> Result<Self> {
        Self::with_proportions(&Proportions::usual(thumb))
    }

    /// A pistol of given proportions.
    ///
    /// # Errors
    /// When a proportion is not finite or outside its documented range, or when the thumb begins
    /// beyond the finger's tip, so that there is no crotch.
    pub fn with_proportions(proportions: &Proportions) -> Result<Self> {
        let pieces = pistol_outline(proportions)?;
        let mirror = match proportions.thumb {
            Some((HandSide::Left, _)) => -1.0,
            _ => 1.0,
        };
        let hand = if mirror < 0.0 { HandSide::Left } else { HandSide::Right };
        let thumb = match proportions.thumb {
            Some((HandSide::Left, _)) => Thumb::Left,
            Some((HandSide::Right, _)) => Thumb::Right,
            None => Thumb::None,
        };
        let slimmer = proportions
            .thumb
            .as_ref()
            .map_or(f64::INFINITY, |(_, thumb)| thumb.half_width)
            .min(proportions.half_width);
        let knot_step = KNOT_STEP.min(KNOT_STEP_IN_HALF_WIDTHS * slimmer);
        let mut breaks = vec![0.0];
        let mut points = Vec::new();
        let mut parameters = Vec::new();
        let mut crotch = None;
        for (i, piece) in pieces.iter().enumerate() {
            let start = breaks[breaks.len() - 1];
            let spans = (piece.length() / knot_step).ceil();
            let samples = spans as usize * POINTS_PER_CONTROL_POINT;
            for k in usize::from(i > 0)..=samples {
                let part = k as f64 / samples as f64;
                let m = piece.at(part * piece.length());
                points.push(Point2::new(m.x, mirror * m.y));
                parameters.push(start + part * piece.length());
            }
            breaks.extend((1..=spans as usize).map(|k| start + k as f64 / spans * piece.length()));
            if i + 1 < pieces.len() {
                crotch = breaks.last().copied();
                // The crotch: a triple knot makes a corner.
                let corner = breaks[breaks.len() - 1];
                breaks.extend([corner, corner]);
            }
        }
        let spline = BSpline::open_clamped(Degree::Cubic, &breaks)?;
        let control_points =
            spline.fit(&points, Parametrization::Given(&parameters))?.control_points;
        let proportions = Some(*proportions);
        Ok(Self { spline, control_points, hand, thumb, crotch, proportions })
    }

    /// The pistol of the same kind with the dimensions of a band template's shape vector: the
    /// initial template adapted to a hand. It has no thumb unless `has_thumb`.
    ///
    /// # Errors
    /// [`Error::Unsupported`] for a traced outline; those of
    /// [`with_proportions`](Self::with_proportions) for a hand beyond their ranges.
    pub fn fitted(&self, hand: &SVector<f64, 9>, length_px: f64, has_thumb: bool) -> Result<Self> {
        let Some(proportions) = &self.proportions else {
            return Err(Error::Unsupported {
                what: "a template fitted to a hand",
                needs: "a pistol template",
            });
        };
        let mut proportions = *proportions;
        proportions.half_width = hand[3] / length_px;
        proportions.thumb = proportions.thumb.filter(|_| has_thumb);
        if let Some((side, thumb)) = &mut proportions.thumb {
            let spine = Vector2::new(hand[6], hand[7]);
            let e = Vector2::new(hand[2].cos(), hand[2].sin());
            thumb.base = hand[5] / length_px;
            thumb.angle_rad = side.sign() * e.perp(&spine).atan2(e.dot(&spine));
            thumb.half_width = hand[8] / length_px;
            thumb.length = spine.norm() / length_px + thumb.half_width;
        }
        Self::with_proportions(&proportions)
    }

    /// A template from a traced outline and its pointing axis.
    ///
    /// `outline` has at least `control_points` points in order along the contour, in any unit and
    /// in axes like the image's. `hand` is the side of that order on which the hand lies. `axis`
    /// leads from the finger's knuckle to its tip, in the same unit.
    ///
    /// # Errors
    /// [`Error::TooFew`] for fewer than four control points or fewer outline points than control
    /// points, [`Error::NotFiniteAt`] for an outline point, [`Error::UnusableLength`] for an axis
    /// or an outline without length, and the errors of [`BSpline::fit`].
    pub fn from_outline(
        outline: &[Point2<f64>],
        axis: &OutlineAxis,
        hand: HandSide,
        control_points: usize,
    ) -> Result<Self> {
        let along = axis.tip - axis.knuckle;
        let length = along.norm();
        if !(length > 0.0 && length.is_finite()) {
            return Err(Error::UnusableLength { what: "template's axis", length });
        }
        let (e, middle) = (along / length, nalgebra::center(&axis.knuckle, &axis.tip));
        let points: Vec<_> = outline
            .iter()
            .map(|x| {
                let d = (x - middle) / length;
                Point2::new(d.dot(&e), e.perp(&d))
            })
            .collect();
        // Checked before a spline with the requested number of control points is allocated.
        check_count("outline points", outline.len(), control_points)?;
        let spline = BSpline::open_uniform(Degree::Cubic, control_points)?;
        let control_points = spline.fit(&points, Parametrization::ChordLength)?.control_points;
        let (thumb, crotch, proportions) = (Thumb::None, None, None);
        Ok(Self { spline, control_points, hand, thumb, crotch, proportions })
    }

    /// The spline and its control points (p, q).
    #[must_use]
    pub fn outline(&self) -> (&BSpline, &[Point2<f64>]) {
        (&self.spline, &self.control_points)
    }

    /// The side of the outline's direction of travel on which the hand lies.
    #[must_use]
    pub fn hand(&self) -> HandSide {
        self.hand
    }

    /// Side of the thumb; `None` for a finger alone and for a traced outline.
    #[must_use]
    pub fn thumb(&self) -> Thumb {
        self.thumb
    }

    /// The proportions of the template, unless it was traced.
    #[must_use]
    pub fn proportions(&self) -> Option<&Proportions> {
        self.proportions.as_ref()
    }

    /// `along` and `radial` of a sample; for a traced outline the spine is the axis.
    fn limb_coordinates(&self, s: &ContourSample, limb: Limb) -> (f64, Vector2<f64>) {
        let Some(Proportions { half_width, thumb, .. }) = &self.proportions else {
            return (s.position.x, s.normal);
        };
        if let (Limb::Thumb, Some((side, thumb))) = (limb, thumb) {
            let (sin, cos) = thumb.angle_rad.sin_cos();
            let (along, facing) = (Vector2::new(cos, sin), Vector2::new(sin, -cos));
            let m = Vector2::new(s.position.x - thumb.base, side.sign() * s.position.y);
            let spine = thumb.length - thumb.half_width;
            return on_band(m.dot(&along), m.dot(&facing), spine, spine);
        }
        on_band(s.position.x, s.position.y, HALF_LENGTH - half_width, 1.0)
    }

    /// `count` samples of the outline at equal steps of arc length.
    ///
    /// # Errors
    /// Those of [`contour::sample`].
    pub fn samples(&self, count: usize) -> Result<Vec<TemplateSample>> {
        let samples = contour::sample(&self.spline, &self.control_points, count, self.hand)?;
        Ok(samples
            .into_iter()
            .map(|s| {
                let limb = match self.crotch {
                    Some(crotch) if s.parameter > crotch => Limb::Thumb,
                    _ => Limb::Finger,
                };
                let (along, radial) = self.limb_coordinates(&s, limb);
                TemplateSample { position: s.position, normal: s.normal, limb, along, radial }
            })
            .collect())
    }
}

/// Foot of a point's normal on a band's spine, in units of `unit`, and that normal; the centre of
/// the band's round end is at `end`.
fn on_band(along: f64, across: f64, end: f64, unit: f64) -> (f64, Vector2<f64>) {
    if along <= end {
        (along / unit, Vector2::new(0.0, across.signum()))
    } else {
        (end / unit, Vector2::new(along - end, across).normalize())
    }
}

/// The pointing axis of a traced outline, in the outline's unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OutlineAxis {
    /// Start of the visible finger.
    pub knuckle: Point2<f64>,
    /// Its end: the apex.
    pub tip: Point2<f64>,
}

/// A smooth piece of an outline: straight lines and arcs, each beginning at the end of the last.
#[derive(Debug, Default)]
struct OutlinePiece {
    segments: Vec<Segment>,
}

#[derive(Debug)]
enum Segment {
    Line {
        from: Point2<f64>,
        to: Point2<f64>,
    },
    /// Anticlockwise in (p, q) for a negative sweep.
    Arc {
        centre: Point2<f64>,
        radius: f64,
        from_rad: f64,
        sweep_rad: f64,
    },
}

impl Segment {
    fn length(&self) -> f64 {
        match self {
            Self::Line { from, to } => (to - from).norm(),
            Self::Arc { radius, sweep_rad, .. } => radius * sweep_rad.abs(),
        }
    }

    /// The point at a fraction of the segment, 0–1.
    fn at(&self, part: f64) -> Point2<f64> {
        match self {
            Self::Line { from, to } => from + (to - from) * part,
            Self::Arc { centre, radius, from_rad, sweep_rad } => {
                let (sin, cos) = (from_rad + sweep_rad * part).sin_cos();
                centre + Vector2::new(cos, sin) * *radius
            }
        }
    }
}

impl OutlinePiece {
    fn length(&self) -> f64 {
        self.segments.iter().map(Segment::length).sum()
    }

    /// The point at the length `s` from the start.
    fn at(&self, s: f64) -> Point2<f64> {
        let mut left = s;
        let mut end = Point2::origin();
        for segment in &self.segments {
            let length = segment.length();
            if left <= length && length > 0.0 {
                return segment.at(left / length);
            }
            left -= length;
            end = segment.at(1.0);
        }
        end
    }
}

/// The outline of a pistol with the thumb at +q, the hand to the right of the direction of travel:
/// one smooth piece up to the crotch, one round the thumb.
fn pistol_outline(proportions: &Proportions) -> Result<Vec<OutlinePiece>> {
    let Proportions { half_width: w, flank_start, thumb } = *proportions;
    Error::within("finger half-width", w, "0.03 to 0.4", |w| (0.03..=0.4).contains(&w))?;
    Error::within("flank start", flank_start, "-0.5 to 0.3 and below the round tip", |p| {
        (-0.5..=0.3).contains(&p) && p < HALF_LENGTH - w
    })?;
    let tip = Point2::new(HALF_LENGTH - w, 0.0);
    let outer = Segment::Line { from: Point2::new(flank_start, -w), to: Point2::new(tip.x, -w) };
    let round = Segment::Arc { centre: tip, radius: w, from_rad: -FRAC_PI_2, sweep_rad: PI };
    let inner = |end| Segment::Line { from: Point2::new(tip.x, w), to: Point2::new(end, w) };
    let Some((_, thumb)) = thumb else {
        return Ok(vec![OutlinePiece { segments: vec![outer, round, inner(flank_start)] }]);
    };
    let ThumbProportions { base, angle_rad, length, half_width: w2, far_flank } = thumb;
    Error::within("thumb base", base, "-1 to 0.5", |p| (-1.0..=0.5).contains(&p))?;
    Error::within("thumb angle [rad]", angle_rad, "0.5 to 2", |a| (0.5..=2.0).contains(&a))?;
    Error::within("thumb length", length, "0.3 to 2", |l| (0.3..=2.0).contains(&l))?;
    Error::within("thumb half-width", w2, "0.03 to 0.4", |w| (0.03..=0.4).contains(&w))?;
    Error::within("far flank", far_flank, "0 to 1", |f| (0.0..=1.0).contains(&f))?;
    Error::within("thumb length beyond its round end", length - w2, "positive", |l| l > 0.0)?;
    let (sin, cos) = angle_rad.sin_cos();
    let (along, near) = (Vector2::new(cos, sin), Vector2::new(sin, -cos) * w2);
    let base = Point2::new(base, 0.0);
    // The thumb's near flank intersects the finger's inner one, q = w, at the crotch.
    let crotch = base + along * ((w + w2 * cos) / sin) + near;
    let end = base + along * (length - w2);
    Error::within("crotch", crotch.x, "below the finger's round tip", |p| p < tip.x)?;
    Error::within(
        "thumb length beyond the crotch",
        (end + near - crotch).dot(&along),
        "positive",
        |l| l > 0.0,
    )?;
    let finger = OutlinePiece { segments: vec![outer, round, inner(crotch.x)] };
    let far = end - near;
    let thumb = OutlinePiece {
        segments: vec![
            Segment::Line { from: crotch, to: end + near },
            Segment::Arc {
                centre: end,
                radius: w2,
                from_rad: angle_rad - FRAC_PI_2,
                sweep_rad: PI,
            },
            Segment::Line { from: far, to: far - along * (far_flank * (length - w2)) },
        ],
    };
    Ok(vec![finger, thumb])
}
