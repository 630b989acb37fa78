//! Errors in the input of this crate. Every variant carries the offending value, and its message
//! states the values that are accepted. A lost hand is not an error but a status of the tracker.

/// Result of a function that can refuse its input.
pub type Result<T> = std::result::Result<T, Error>;

/// Input that this crate refuses.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// A quantity that has to be finite is NaN or infinite.
    #[error("{what} is {value}; it must be finite")]
    NotFinite {
        /// The quantity, with its unit.
        what: &'static str,
        /// Its value.
        value: f64,
    },
    /// A quantity lies outside the range its documentation states.
    #[error("{what} is {value}; it must be {right}")]
    OutOfRange {
        /// The quantity, with its unit.
        what: &'static str,
        /// Its value.
        value: f64,
        /// The range that would be right, in words.
        right: &'static str,
    },
    /// The template lacks a requirement of an operation or model.
    #[error("{what} needs {needs}")]
    Unsupported {
        /// The operation or model.
        what: &'static str,
        /// Its requirement.
        needs: &'static str,
    },
    /// A covariance that leaves some combination of its components without a variance.
    #[error("the {what} is not positive definite; every combination needs a positive variance")]
    NotPositiveDefinite {
        /// The covariance.
        what: &'static str,
    },
    /// An image without pixels.
    #[error("the image is {width} × {height} px; both sides must be at least 1 px")]
    EmptyImage {
        /// Width in px.
        width: usize,
        /// Height in px.
        height: usize,
    },
    /// An image with a side that is too long for exact pixel coordinates in `f32`.
    #[error("the image is {width} × {height} px; no side may exceed {limit} px")]
    ImageTooLarge {
        /// Width in px.
        width: usize,
        /// Height in px.
        height: usize,
        /// The longest side accepted, in px.
        limit: usize,
    },
    /// Rows that would overlap.
    #[error(
        "the stride is {stride} bytes; a row of {width} px needs at least {}", .width * .pixel_bytes
    )]
    StrideTooSmall {
        /// Bytes from one row to the next.
        stride: usize,
        /// Width in px.
        width: usize,
        /// Bytes of a pixel: 1 of a grey image, 3 of colours.
        pixel_bytes: usize,
    },
    /// Fewer bytes than the image's shape needs.
    #[error(
        "{given} bytes of pixels for {width} × {height} px with a stride of {stride} bytes; \
         (height − 1) · stride + {} bytes are needed", .width * .pixel_bytes
    )]
    PixelsMissing {
        /// Bytes given.
        given: usize,
        /// Width in px.
        width: usize,
        /// Height in px.
        height: usize,
        /// Bytes from one row to the next.
        stride: usize,
        /// Bytes of a pixel: 1 of a grey image, 3 of colours.
        pixel_bytes: usize,
    },
    /// A grey image and its colours that are not of one size.
    #[error("the colours are {} × {} px and the grey image {} × {} px; they must be of one size", .colour.0, .colour.1, .gray.0, .gray.1)]
    SizesDiffer {
        /// Width and height of the grey image in px.
        gray: (usize, usize),
        /// Width and height of the colours in px.
        colour: (usize, usize),
    },
    /// A known background that is not of the size of the frame before it.
    #[error("the background is {} × {} px and the frame {} × {} px; they must be of one size", .background.0, .background.1, .gray.0, .gray.1)]
    BackgroundSize {
        /// Width and height of the frame in px.
        gray: (usize, usize),
        /// Width and height of the background in px.
        background: (usize, usize),
    },
    /// A sequence is too short for its purpose.
    #[error("{given} {what}; at least {needed} are needed")]
    TooFew {
        /// The counted things.
        what: &'static str,
        /// Their number.
        given: usize,
        /// The least number that is accepted.
        needed: usize,
    },
    /// A sequence does not match another one in length.
    #[error("{given} {what}; exactly {needed} are needed")]
    WrongCount {
        /// The counted things.
        what: &'static str,
        /// Their number.
        given: usize,
        /// The required number.
        needed: usize,
    },
    /// One of several values that have to be finite is not.
    #[error("{what} {index} has {value}; it must be finite")]
    NotFiniteAt {
        /// What the values are.
        what: &'static str,
        /// The first one that is not finite, counted from 0.
        index: usize,
        /// The value.
        value: f64,
    },
    /// A B-spline's degree is neither 2 nor 3.
    #[error("degree {degree} is not supported; a B-spline is quadratic (2) or cubic (3) here")]
    UnsupportedDegree {
        /// The degree given.
        degree: usize,
    },
    /// A knot lies before its predecessor.
    #[error("knot {index} is {knot}, less than the {previous} before it; knots must not decrease")]
    KnotsDecrease {
        /// The index of the knot, counted from 0.
        index: usize,
        /// The knot.
        knot: f64,
        /// Its predecessor.
        previous: f64,
    },
    /// A knot repeated so often that the curve would break there.
    #[error(
        "knot {knot} occurs {multiplicity} times; at most {allowed} keep the curve in one piece"
    )]
    KnotMultiplicity {
        /// The knot.
        knot: f64,
        /// How often it occurs.
        multiplicity: usize,
        /// How often it may.
        allowed: usize,
    },
    /// Two neighbouring knots that are neither equal nor usefully apart.
    #[error(
        "the knots at {start} are {span} apart; they must be equal or between {least} and \
         {greatest} apart"
    )]
    KnotSpan {
        /// The first of the two knots.
        start: f64,
        /// The distance to the next.
        span: f64,
        /// The least distance for these knots.
        least: f64,
        /// The greatest distance.
        greatest: f64,
    },
    /// Knots that leave the curve no domain.
    #[error("the knots leave the domain [{start}, {end}]; it must have an inside")]
    EmptyDomain {
        /// The domain's start.
        start: f64,
        /// Its end.
        end: f64,
    },
    /// A parameter at which an open B-spline does not exist.
    #[error("parameter {parameter} is outside the B-spline's domain [{start}, {end}]")]
    OutsideDomain {
        /// The parameter.
        parameter: f64,
        /// The domain's start.
        start: f64,
        /// Its end.
        end: f64,
    },
    /// A curve, polygon or outline that cannot be measured: all its points coincide, or its
    /// coordinates overflow.
    #[error("the length of the {what} is {length}; it must be positive and finite")]
    UnusableLength {
        /// What was measured.
        what: &'static str,
        /// Its length.
        length: f64,
    },
    /// A least-squares fit of control points that the outline does not determine.
    #[error(
        "the outline determines {rank} of {control_points} control points; every one needs an \
         outline point of its own where its basis function is not zero (Schoenberg–Whitney)"
    )]
    UndeterminedControlPoints {
        /// The rank of the fit.
        rank: usize,
        /// The number of control points.
        control_points: usize,
    },
}

impl Error {
    /// `value`, or the error that it is not finite.
    pub(crate) fn finite(what: &'static str, value: f64) -> Result<f64> {
        if value.is_finite() { Ok(value) } else { Err(Self::NotFinite { what, value }) }
    }

    /// `value`, or the error that `accepts` rejects it.
    pub(crate) fn within(
        what: &'static str,
        value: f64,
        right: &'static str,
        accepts: impl Fn(f64) -> bool,
    ) -> Result<f64> {
        if accepts(Self::finite(what, value)?) {
            Ok(value)
        } else {
            Err(Self::OutOfRange { what, value, right })
        }
    }
}
