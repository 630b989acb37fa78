//! Two views of a finger that points at a table, to the point of the table that it indicates.
//!
//! Each view knows its plane by four reference points, and nothing else of its camera. A finger line l
//! of the image is the line Tᵀ l of the plane, T the homography from plane to image (Cipolla,
//! Hadfield & Hollinghurst 1994, equation 2); two such lines meet in the indicated point.

use fingerpost_core::nalgebra::{
    Matrix2, Matrix3, Point2, Point3, SMatrix, SVector, Vector2, Vector3,
};
use fingerpost_core::{
    ContourTracker, FingerLine, Frame, GrayView, StartPose, Template, Thumb, TrackerOptions,
};
use std::error::Error;
use std::io::{self, Write};

type Any<T> = Result<T, Box<dyn Error>>;

const SIZE: (usize, usize) = (640, 480);
/// Where the finger points [mm], from where, and the corners of the table that both views know.
const TARGET: [f64; 2] = [180.0, 140.0];
const TIP: [f64; 3] = [120.0, 60.0, 90.0];
const CORNERS: [[f64; 2]; 4] = [[0.0, 0.0], [300.0, 0.0], [300.0, 200.0], [0.0, 200.0]];

fn main() -> Any<()> {
    let (point, covariance) = indicated()?;
    let sigma = covariance.symmetric_eigenvalues().map(f64::sqrt);
    writeln!(io::stdout(), "indicated ({:.2}, {:.2}) mm", point.x, point.y)?;
    writeln!(io::stdout(), "true      ({:.2}, {:.2}) mm", TARGET[0], TARGET[1])?;
    writeln!(io::stdout(), "standard deviations {:.2} and {:.2} mm", sigma.min(), sigma.max())?;
    Ok(())
}

/// Follows the finger in both views, and takes their lines to a point.
fn indicated() -> Any<(Point2<f64>, Matrix2<f64>)> {
    let (target, tip) = (Point3::new(TARGET[0], TARGET[1], 0.0), Point3::from(TIP));
    let knuckle = tip + (tip - target).normalize() * 80.0;
    let mut views = Vec::new();
    for eye in [Point3::new(-350.0, -600.0, 700.0), Point3::new(750.0, -450.0, 650.0)] {
        let camera = Camera::looking_at(eye, Point3::new(150.0, 90.0, 30.0));
        let corners = CORNERS.map(|[x, y]| camera.image_of(&Point3::new(x, y, 0.0)));
        let finger_line = follow(camera.image_of(&tip), camera.image_of(&knuckle))?;
        views.push((homography(&CORNERS.map(Point2::from), &corners)?, finger_line));
    }
    intersection(&views).ok_or_else(|| "the lines are parallel".into())
}

/// The point of the plane where the finger lines of two views or more meet, by weighted least squares,
/// and its covariance. Each view is its homography from plane to image, and its finger line.
fn intersection(views: &[(Matrix3<f64>, FingerLine)]) -> Option<(Point2<f64>, Matrix2<f64>)> {
    let mut point = Point2::origin();
    let mut information = Matrix2::zeros();
    // The weights depend on where the point is; the second step has them where it matters.
    for _ in 0..3 {
        let mut right = Vector2::zeros();
        information = Matrix2::zeros();
        for (image_from_plane, FingerLine { axis, covariance, .. }) in views {
            let (normal, anchor) = (axis.normal(), axis.anchor.coords);
            let line =
                image_from_plane.tr_mul(&Vector3::new(normal.x, normal.y, -normal.dot(&anchor)));
            // The point in the image, its distance along the line, and the line's variance there.
            let image = image_from_plane * Vector3::new(point.x, point.y, 1.0);
            let along = (image.xy() / image.z - anchor).dot(&axis.direction());
            let lever = Vector2::new(1.0, along);
            let weight = 1.0 / (image.z.powi(2) * lever.dot(&(covariance * lever)));
            information += weight * line.xy() * line.xy().transpose();
            right -= weight * line.z * line.xy();
        }
        point = Point2::from(information.try_inverse()? * right);
    }
    Some((point, information.try_inverse()?))
}

/// The homography that takes four points of the plane to four of the image, with h₃₃ = 1.
fn homography(plane: &[Point2<f64>; 4], image: &[Point2<f64>; 4]) -> Any<Matrix3<f64>> {
    let mut rows = SMatrix::<f64, 8, 8>::zeros();
    let mut right = SVector::<f64, 8>::zeros();
    for (k, (p, q)) in plane.iter().zip(image).enumerate() {
        let [x, y, u, v] = [p.x, p.y, q.x, q.y];
        rows.set_row(2 * k, &[x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y].into());
        rows.set_row(2 * k + 1, &[0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y].into());
        (right[2 * k], right[2 * k + 1]) = (u, v);
    }
    let h = rows.lu().solve(&right).ok_or("three reference points lie on a line")?;
    Ok(Matrix3::new(h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], 1.0))
}

/// The finger line of a bright finger between two points of the image, followed for some frames.
fn follow(tip: Point2<f64>, knuckle: Point2<f64>) -> Any<FingerLine> {
    let along = (tip - knuckle).normalize();
    let (angle_rad, half_width_px) = (along.y.atan2(along.x), 8.0);
    let axis_end = tip - along * half_width_px;
    let pixels: Vec<u8> = (0..SIZE.0 * SIZE.1)
        .map(|i| {
            let d = Point2::new((i % SIZE.0) as f64, (i / SIZE.0) as f64) - axis_end;
            let inside = half_width_px - (d - along * d.dot(&along).min(0.0)).norm();
            (60.0 + 100.0 * (0.5 + 0.5 * inside).clamp(0.0, 1.0)) as u8
        })
        .collect();
    let frame = Frame::gray(GrayView::new(&pixels, SIZE.0, SIZE.1, SIZE.0)?);
    // The template starts some pixels and degrees off.
    let tip_px = tip + Vector2::new(4.0, -3.0);
    let start = StartPose { tip_px, angle_rad: angle_rad + 0.05, length_px: 70.0 };
    let mut tracker =
        ContourTracker::new(Template::pistol(Thumb::None)?, &start, TrackerOptions::default())?;
    let mut line = None;
    for k in 0..10 {
        line = tracker.update(&frame, f64::from(k) / 30.0)?.finger_line;
    }
    line.ok_or_else(|| "the finger was not followed".into())
}

/// A pinhole, which only makes the pictures: nothing of it is used to find the point.
struct Camera {
    eye: Point3<f64>,
    axes: Matrix3<f64>,
}

impl Camera {
    fn looking_at(eye: Point3<f64>, at: Point3<f64>) -> Self {
        let forward = (at - eye).normalize();
        let right = forward.cross(&Vector3::z()).normalize();
        let down = forward.cross(&right);
        Self { eye, axes: Matrix3::from_rows(&[right, down, forward].map(|axis| axis.transpose())) }
    }

    fn image_of(&self, point: &Point3<f64>) -> Point2<f64> {
        let ray = self.axes * (point - self.eye);
        Point2::new(319.5, 239.5) + 900.0 * ray.xy() / ray.z
    }
}

#[test]
fn the_point_is_the_one_that_is_pointed_at() -> Any<()> {
    let (point, covariance) = indicated()?;
    assert!((point - Point2::from(TARGET)).norm() < 0.2, "{point}");
    // Without noise the fit is as good as rounding to grey levels lets it be.
    assert!(covariance.symmetric_eigenvalues().max().sqrt() < 0.2, "{covariance}");
    Ok(())
}
