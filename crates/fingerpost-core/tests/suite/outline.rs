//! Straight edges at all angles and places, lines with outliers, invalid input.

use fingerpost_core::GrayView;
use fingerpost_core::measure::outline::{EdgePolarity, edges_along, fit_line};
use fingerpost_core::nalgebra::{Point2, Vector2};

/// A picture of a step along a line through `at` at an angle, blurred by σ = 0.8 px.
fn step_picture(side: usize, at: Point2<f64>, angle_rad: f64) -> Vec<u8> {
    let normal = Vector2::new(-angle_rad.sin(), angle_rad.cos());
    let level = |i: usize| {
        let p = Point2::new((i % side) as f64, (i / side) as f64);
        // A logistic function, symmetric about the line as a blurred step is.
        let d = normal.dot(&(p - at));
        60.0 + 140.0 / (1.0 + (-d * 1.702 / 0.8).exp())
    };
    (0..side * side).map(|i| level(i).round() as u8).collect()
}

#[test]
fn a_line_is_found_at_any_angle_and_place() {
    let side = 160;
    for k in 0..24 {
        let angle = f64::from(k) * 0.2617 + 0.05;
        let at = Point2::new(80.0 + 0.13 * f64::from(k), 79.6);
        let pixels = step_picture(side, at, angle);
        let image = GrayView::new(&pixels, side, side, side).unwrap();
        let along = Vector2::new(angle.cos(), angle.sin());
        let off = Vector2::new(-along.y, along.x) * 2.2;
        let path = [at - along * 60.0 + off, at + along * 60.0 + off];
        let edges = edges_along(&image, &path, 4.0, EdgePolarity::Rising, 10.0).unwrap();
        assert!(edges.len() > 25, "{} at {angle}", edges.len());
        let points: Vec<_> = edges.iter().map(|e| e.position).collect();
        let sigmas: Vec<_> = edges.iter().map(|e| e.sigma_px).collect();
        let line = fit_line(&points, &sigmas).unwrap().unwrap();
        let normal = Vector2::new(-along.y, along.x);
        assert!(normal.dot(&(line.point - at)).abs() < 0.01, "{line:?}");
        let turn = (line.angle_rad - angle).rem_euclid(std::f64::consts::TAU);
        assert!(turn.min(std::f64::consts::TAU - turn) < 5e-4, "{line:?} {angle}");
        let wrong = edges_along(&image, &path, 4.0, EdgePolarity::Falling, 10.0).unwrap();
        assert!(wrong.is_empty());
    }
}

#[test]
fn outliers_do_not_bias_a_line() {
    let points: Vec<_> = (0..40)
        .map(|k| Point2::new(f64::from(k), if k % 5 < 2 { 3.0 } else { 0.01 * f64::from(k % 3) }))
        .collect();
    let line = fit_line(&points, &[0.1; 40]).unwrap().unwrap();
    assert!(line.point.y.abs() < 0.03 && line.angle_rad.abs() < 1e-3);
    assert!((line.share - 0.6).abs() < 0.05);
}

#[test]
fn too_few_points_give_no_line() {
    assert_eq!(fit_line(&[Point2::origin(); 4], &[1.0; 4]).unwrap(), None);
    assert_eq!(fit_line(&[Point2::origin(); 9], &[1.0; 9]).unwrap(), None);
    assert!(fit_line(&[Point2::origin(); 9], &[0.0; 9]).is_err());
    let pixels = [0; 64];
    let image = GrayView::new(&pixels, 8, 8, 8).unwrap();
    let path = [Point2::new(-50.0, 3.0), Point2::new(f64::NAN, 0.0)];
    assert!(edges_along(&image, &path, 3.0, EdgePolarity::Any, 1.0).is_err());
    assert!(edges_along(&image, &path[..1], 0.0, EdgePolarity::Any, 1.0).is_err());
    let far = [Point2::new(-1e9, 3.0), Point2::new(1e9, 4.0)];
    assert!(edges_along(&image, &far, 3.0, EdgePolarity::Any, 1.0).unwrap().is_empty());
}
