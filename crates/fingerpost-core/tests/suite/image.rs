//! Image views compared with the definitions of strided images and bilinear interpolation.

use fingerpost_core::Error;
use fingerpost_core::image::frame::ColourView;
use fingerpost_core::image::gray::GrayView;
use proptest::prelude::*;
use proptest::test_runner::{Config, RngSeed};

/// Four products of a u8 and two fractions, each rounded to half an ulp of 255.
const F64_TOLERANCE: f64 = 1e-12;
const F32_TOLERANCE: f64 = 1e-4;

fn config() -> Config {
    Config { rng_seed: RngSeed::Fixed(0x696d_6167), failure_persistence: None, ..Config::default() }
}

/// An owned image to take views of.
#[derive(Debug, Clone)]
struct Pixels {
    bytes: Vec<u8>,
    width: usize,
    height: usize,
    stride: usize,
}

impl Pixels {
    fn view(&self) -> GrayView<'_> {
        GrayView::new(&self.bytes, self.width, self.height, self.stride).unwrap()
    }

    /// Bilinear interpolation by its definition, a weighted sum over all pixels.
    fn tent_sum(&self, u: f64, v: f64) -> f64 {
        let tent = |d: f64| (1.0 - d.abs()).max(0.0);
        (0..self.height)
            .flat_map(|y| (0..self.width).map(move |x| (x, y)))
            .map(|(x, y)| {
                tent(u - x as f64) * tent(v - y as f64) * f64::from(self.bytes[y * self.stride + x])
            })
            .sum()
    }
}

/// Small images with padding and trailing bytes, half of them one pixel wide or high.
fn pixels() -> impl Strategy<Value = Pixels> {
    let side = || prop_oneof![Just(1_usize), 1..7_usize];
    (side(), side(), 0..4_usize, 0..3_usize)
        .prop_flat_map(|(width, height, padding, rest)| {
            let stride = width + padding;
            let needed = (height - 1) * stride + width;
            (prop::collection::vec(any::<u8>(), needed + rest), Just((width, height, stride)))
        })
        .prop_map(|(bytes, (width, height, stride))| Pixels { bytes, width, height, stride })
}

/// A fraction of a side, half of the time one of its two ends.
fn fraction() -> impl Strategy<Value = f64> {
    prop_oneof![Just(0.0), Just(1.0), 0.0..=1.0]
}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn pixels_and_rows_are_the_bytes_at_the_stride(image in pixels()) {
        let view = image.view();
        prop_assert_eq!(view.data().len(), (image.height - 1) * image.stride + image.width);
        for y in 0..image.height + 2 {
            let row = (y < image.height)
                .then(|| &image.bytes[y * image.stride..y * image.stride + image.width]);
            prop_assert_eq!(view.row(y), row);
            for x in 0..image.stride + 2 {
                prop_assert_eq!(view.pixel(x, y), row.and_then(|row| row.get(x)).copied());
            }
        }
        prop_assert_eq!(view.pixel(usize::MAX, 0), None);
        prop_assert_eq!(view.pixel(0, usize::MAX), None);
    }

    #[test]
    fn samples_match_the_definition(image in pixels(), s in fraction(), t in fraction()) {
        let (u, v) = (s * (image.width - 1) as f64, t * (image.height - 1) as f64);
        let view = image.view();
        prop_assert!((view.sample_f64(u, v).unwrap() - image.tent_sum(u, v)).abs() < F64_TOLERANCE);
        let (u, v) = (u as f32, v as f32);
        let truth = image.tent_sum(f64::from(u), f64::from(v));
        prop_assert!((f64::from(view.sample_f32(u, v).unwrap()) - truth).abs() < F32_TOLERANCE);
    }

    #[test]
    fn pixel_centres_are_exact(image in pixels()) {
        let view = image.view();
        for y in 0..image.height {
            for x in 0..image.width {
                let pixel = view.pixel(x, y);
                prop_assert_eq!(view.sample_f32(x as f32, y as f32), pixel.map(f32::from));
                prop_assert_eq!(view.sample_f64(x as f64, y as f64), pixel.map(f64::from));
            }
        }
    }

    #[test]
    fn a_sample_exists_exactly_where_the_image_does(
        image in pixels(),
        u in any::<f64>(),
        v in -1.0..8.0_f64,
    ) {
        let view = image.view();
        for (u, v) in [(u, v), (v, u), (v, v), (-0.0, v)] {
            let inside = (0.0..=(image.width - 1) as f64).contains(&u)
                && (0.0..=(image.height - 1) as f64).contains(&v);
            prop_assert_eq!(view.sample_f64(u, v).is_some(), inside);
            prop_assert_eq!(view.contains(u, v, 0.0), inside);
            let (u, v) = (u as f32, v as f32);
            let inside = (0.0..=(image.width - 1) as f32).contains(&u)
                && (0.0..=(image.height - 1) as f32).contains(&v);
            prop_assert_eq!(view.sample_f32(u, v).is_some(), inside);
        }
    }
}

#[test]
fn the_next_float_beyond_the_border_is_outside() {
    let bytes = [7; 12];
    let view = GrayView::new(&bytes, 4, 3, 4).unwrap();
    assert_eq!(view.sample_f64(3.0, 2.0), Some(7.0));
    assert_eq!(view.sample_f64(3.0_f64.next_up(), 2.0), None);
    assert_eq!(view.sample_f64(3.0, 2.0_f64.next_up()), None);
    assert_eq!(view.sample_f64(0.0_f64.next_down(), 0.0), None);
    assert_eq!(view.sample_f32(3.0_f32.next_up(), 2.0), None);
    assert_eq!(view.sample_f32(3.0, 2.0_f32.next_up()), None);
    assert_eq!(view.sample_f32(0.0, 0.0_f32.next_down()), None);
    for u in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        assert_eq!(view.sample_f64(u, 1.0), None);
        assert_eq!(view.sample_f64(1.0, u), None);
        assert_eq!(view.sample_f32(u as f32, 1.0), None);
        assert_eq!(view.sample_f32(1.0, u as f32), None);
    }
}

#[test]
fn padding_is_never_sampled() {
    let bytes = [10, 20, 255, 255, 30, 40, 255, 255];
    let view = GrayView::new(&bytes, 2, 2, 4).unwrap();
    assert_eq!(view.sample_f64(1.0, 0.5), Some(30.0));
    assert_eq!(view.sample_f64(1.0, 1.0), Some(40.0));
    assert_eq!(view.data(), &bytes[..6]);
}

#[test]
fn the_margin_shrinks_the_image_on_every_side() {
    let bytes = [0; 30];
    let view = GrayView::new(&bytes, 6, 5, 6).unwrap();
    for (u, v) in [(2.0, 2.0), (3.0, 2.0)] {
        assert!(view.contains(u, v, 2.0));
    }
    for (u, v) in [(1.9, 2.0), (3.1, 2.0), (2.5, 1.9), (2.5, 2.1)] {
        assert!(!view.contains(u, v, 2.0), "({u}, {v})");
    }
    assert!(view.contains(-0.5, 4.5, -0.5));
    assert!(!view.contains(2.0, 2.0, f64::NAN));
    assert!(!view.contains(f64::NAN, 2.0, 0.0));
}

#[test]
fn a_shape_that_does_not_fit_the_bytes_is_refused() {
    let bytes = [0; 11];
    assert_eq!(GrayView::new(&bytes, 0, 3, 4), Err(Error::EmptyImage { width: 0, height: 3 }));
    assert_eq!(GrayView::new(&[], 4, 0, 4), Err(Error::EmptyImage { width: 4, height: 0 }));
    assert_eq!(
        GrayView::new(&bytes, 4, 2, 3),
        Err(Error::StrideTooSmall { stride: 3, width: 4, pixel_bytes: 1 })
    );
    let missing = |width, height, stride| {
        Err(Error::PixelsMissing { given: bytes.len(), width, height, stride, pixel_bytes: 1 })
    };
    assert!(GrayView::new(&bytes, 3, 3, 4).is_ok());
    assert_eq!(GrayView::new(&bytes, 4, 3, 4), missing(4, 3, 4));
    // (height − 1) · stride, and the width added to it, overflow.
    assert_eq!(GrayView::new(&bytes, 4, 4, usize::MAX / 2), missing(4, 4, usize::MAX / 2));
    assert_eq!(GrayView::new(&bytes, 4, 2, usize::MAX), missing(4, 2, usize::MAX));
    let (width, limit) = (usize::MAX, GrayView::MAX_SIDE);
    assert_eq!(
        GrayView::new(&bytes, width, 1, width),
        Err(Error::ImageTooLarge { width, height: 1, limit })
    );
}

#[test]
fn colours_are_refused_with_the_width_of_their_image() {
    let refusal = |bytes: &[u8], width, height, stride| {
        ColourView::new(bytes, width, height, stride).unwrap_err()
    };
    let bytes = [0; 23];
    assert!(ColourView::new(&bytes[..21], 3, 2, 12).is_ok());
    assert_eq!(refusal(&bytes, 5, 0, 15), Error::EmptyImage { width: 5, height: 0 });
    let narrow = refusal(&bytes, 4, 2, 11);
    assert_eq!(narrow, Error::StrideTooSmall { stride: 11, width: 4, pixel_bytes: 3 });
    let said = "the stride is 11 bytes; a row of 4 px needs at least 12";
    assert_eq!(narrow.to_string(), said);
    let missing = refusal(&bytes, 4, 2, 12);
    let (given, width, height, stride, pixel_bytes) = (23, 4, 2, 12, 3);
    assert_eq!(missing, Error::PixelsMissing { given, width, height, stride, pixel_bytes });
    let said = "23 bytes of pixels for 4 × 2 px with a stride of 12 bytes; \
                (height − 1) · stride + 12 bytes are needed";
    assert_eq!(missing.to_string(), said);
    let (width, limit) = (usize::MAX, GrayView::MAX_SIDE);
    let large = Error::ImageTooLarge { width, height: 1, limit };
    assert_eq!(refusal(&bytes, width, 1, width), large);
}

#[test]
fn debug_output_has_the_shape_without_the_pixels() {
    let bytes = [173; 6];
    let shown = format!("{:?}", GrayView::new(&bytes, 2, 2, 4).unwrap());
    assert_eq!(shown, "GrayView { width: 2, height: 2, stride: 4, .. }");
}

#[test]
fn colours_are_sampled_like_three_grey_images() {
    let mut state = 7_u32;
    let mut random = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        state >> 8
    };
    let (width, height, stride) = (7, 5, 24);
    let bytes: Vec<u8> = (0..stride * height).map(|_| random() as u8).collect();
    let colour = ColourView::new(&bytes, width, height, stride).unwrap();
    let channels = [0, 1, 2].map(|c| -> Vec<u8> {
        let pixel = |k: usize| bytes[(k / width) * stride + 3 * (k % width) + c];
        (0..width * height).map(pixel).collect()
    });
    let greys = channels.each_ref().map(|c| GrayView::new(c, width, height, width).unwrap());
    let mut inside = 0;
    for _ in 0..2000 {
        // Quarters of a pixel: on pixels, between them, on the border and beyond it.
        let [u, v] = [random() % 34, random() % 26].map(|k| f64::from(k) / 4.0 - 1.0);
        let separate = greys.map(|grey| grey.sample_f64(u, v));
        match colour.sample_f64(u, v) {
            None => assert_eq!(separate, [None; 3], "{u}, {v}"),
            Some(sampled) => {
                inside += 1;
                for (one, other) in sampled.iter().zip(separate) {
                    assert!((one - other.unwrap()).abs() < 1e-9, "{u}, {v}");
                }
            }
        }
    }
    assert!((500..1900).contains(&inside), "{inside}");
    for nowhere in [f64::NAN, f64::INFINITY, -f64::INFINITY] {
        assert_eq!(colour.sample_f64(nowhere, 1.0), None);
        assert_eq!(colour.sample_f64(1.0, nowhere), None);
    }
}
