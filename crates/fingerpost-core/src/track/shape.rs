//! Shape vector of a hand in the image, for either model.

use super::silhouette::Silhouette;
use crate::geometry::planar::AffineMap;
use crate::geometry::ribbon::RibbonVector;
use nalgebra::{Point2, Rotation2, Vector2, Vector3};

/// The state that generates the contour in the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Shape {
    Ribbon(RibbonVector),
    Planar(AffineMap),
}

impl Shape {
    /// (c_u, c_v, θ), the parameters common to both models.
    pub(super) fn placement(&self) -> Vector3<f64> {
        match self {
            Self::Ribbon(x) => x.fixed_rows::<3>(0).into_owned(),
            Self::Planar(map) => {
                let a = map.linear.column(0);
                Vector3::new(map.centre.x, map.centre.y, a.y.atan2(a.x))
            }
        }
    }

    /// The whole hand moved and turned to a placement.
    pub(super) fn placed(&self, at: &Vector3<f64>) -> Self {
        let turn = Rotation2::new(at[2] - self.placement()[2]);
        match *self {
            Self::Ribbon(mut x) => {
                x.fixed_rows_mut::<3>(0).copy_from(at);
                let thumb = turn * Vector2::new(x[6], x[7]);
                (x[6], x[7]) = (thumb.x, thumb.y);
                Self::Ribbon(x)
            }
            Self::Planar(AffineMap { linear, .. }) => Self::Planar(AffineMap {
                centre: Point2::from(at.xy()),
                linear: turn.matrix() * linear,
            }),
        }
    }

    /// The whole hand moved along its finger \[px\].
    pub(super) fn ahead(&self, by_px: f64) -> Self {
        let mut placement = self.placement();
        let (sin, cos) = placement[2].sin_cos();
        placement[0] += by_px * cos;
        placement[1] += by_px * sin;
        self.placed(&placement)
    }

    pub(super) fn silhouette(&self) -> Silhouette {
        match self {
            Self::Ribbon(x) => Silhouette::of_band(x),
            Self::Planar(map) => {
                Silhouette { ahead: map.linear.column(0).normalize(), half_width_px: self.width() }
            }
        }
    }

    /// Half-width of the finger, up to a factor that the template fixes.
    pub(super) fn width(&self) -> f64 {
        match self {
            Self::Ribbon(x) => x[3],
            Self::Planar(map) => map.linear.determinant() / map.linear.column(0).norm(),
        }
    }
}
