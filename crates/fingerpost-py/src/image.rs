//! Frames from NumPy, borrowed without a copy. For a colour image without grey levels, these are
//! computed.

use crate::arrays::as_tuple;
use crate::errors::{InvalidInputError, invalid_input};
use fingerpost_core::image::frame::ColourView;
use fingerpost_core::{Frame, GrayView};
use numpy::{PyArrayMethods, PyReadonlyArrayDyn, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::prelude::*;

/// The arrays of one frame: grey levels, and colours if there are any.
pub struct FrameArrays<'py> {
    gray: Gray<'py>,
    colour: Option<PixelArray<'py>>,
}

impl<'py> FrameArrays<'py> {
    /// The arrays, or an `InvalidInputError` that states the given array and the needed one.
    pub fn new(image: &Bound<'py, PyAny>, colour: Option<&Bound<'py, PyAny>>) -> PyResult<Self> {
        let gray = Gray::Given(PixelArray::new("image", image, Pixel::Gray)?);
        let colour = colour.map(|c| PixelArray::new("colour", c, Pixel::Colour)).transpose()?;
        Ok(Self { gray, colour })
    }

    /// The arrays of a single image, grey or in colour. An image whose channels do not differ, as
    /// that of a monochrome camera, counts as grey.
    pub fn alone(image: &Bound<'py, PyAny>) -> PyResult<Self> {
        if PixelArray::fits(image, Pixel::Gray) {
            return Self::new(image, None);
        }
        let pixels = PixelArray::new("image", image, Pixel::Either)?;
        let colours = pixels.colours()?;
        let (levels, has_colours) = image.py().detach(|| (colours.luma(), colours.has_colours()));
        let Layout { width, height, .. } = pixels.layout;
        let gray = Gray::Made { levels, width, height };
        Ok(Self { gray, colour: has_colours.then_some(pixels) })
    }

    /// Its grey levels.
    pub fn levels(&self) -> PyResult<GrayView<'_>> {
        self.gray.levels().map_err(invalid_input)
    }

    /// The frame in the form that the core takes.
    pub fn frame(&self) -> PyResult<Frame<'_>> {
        let gray = self.levels()?;
        let Some(colour) = &self.colour else { return Ok(Frame::gray(gray)) };
        Frame::coloured(gray, colour.colours()?).map_err(invalid_input)
    }
}

/// Grey levels, given or computed from colours.
enum Gray<'py> {
    Given(PixelArray<'py>),
    Made { levels: Vec<u8>, width: usize, height: usize },
}

impl Gray<'_> {
    fn levels(&self) -> fingerpost_core::Result<GrayView<'_>> {
        match self {
            Self::Given(array) => {
                let Layout { width, height, stride, .. } = array.layout;
                GrayView::new(array.bytes(), width, height, stride)
            }
            Self::Made { levels, width, height } => GrayView::new(levels, *width, *height, *width),
        }
    }
}

/// The form of one pixel.
#[derive(Clone, Copy)]
enum Pixel {
    Gray,
    Colour,
    /// A colour, where a grey level is accepted too.
    Either,
}

impl Pixel {
    /// Description of an array of such pixels.
    fn axes(self) -> &'static str {
        match self {
            Self::Gray => "a 2-D uint8 array (height, width)",
            Self::Colour => "a 3-D uint8 array (height, width, 3)",
            Self::Either => "a uint8 array (height, width), or (height, width, 3) in colour",
        }
    }

    /// Whether this is the shape of an array of such pixels.
    fn fit(self, shape: &[usize]) -> bool {
        match self {
            Self::Gray => shape.len() == 2,
            Self::Colour | Self::Either => shape.len() == 3 && shape[2] == 3,
        }
    }

    fn bytes(self) -> usize {
        match self {
            Self::Gray => 1,
            Self::Colour | Self::Either => 3,
        }
    }
}

/// A NumPy array of bytes with contiguous rows, borrowed.
struct PixelArray<'py> {
    array: PyReadonlyArrayDyn<'py, u8>,
    layout: Layout,
}

/// Memory layout of an image.
#[derive(Clone, Copy)]
struct Layout {
    /// Pixels in a row.
    width: usize,
    /// Rows.
    height: usize,
    /// Bytes from one row to the next.
    stride: usize,
    /// Bytes from the first pixel to the last, at most `isize::MAX`.
    bytes: usize,
}

impl<'py> PixelArray<'py> {
    fn new(what: &str, image: &Bound<'py, PyAny>, pixel: Pixel) -> PyResult<Self> {
        let array = image
            .extract::<PyReadonlyArrayDyn<'py, u8>>()
            .ok()
            .filter(|array| pixel.fit(array.shape()))
            .ok_or_else(|| refused(what, image, pixel.axes()))?;
        let layout = Layout::of(array.shape(), array.strides(), pixel).ok_or_else(|| {
            let needed = "an array whose rows are contiguous, each after the one before; \
                          numpy.ascontiguousarray makes such a copy";
            refused(what, image, needed)
        })?;
        Ok(Self { array, layout })
    }

    /// Whether an image is an array of such pixels, whatever its strides.
    fn fits(image: &Bound<'py, PyAny>, pixel: Pixel) -> bool {
        let array = image.extract::<PyReadonlyArrayDyn<'py, u8>>();
        array.is_ok_and(|array| pixel.fit(array.shape()))
    }

    /// The pixels as colours.
    fn colours(&self) -> PyResult<ColourView<'_>> {
        let Layout { width, height, stride, .. } = self.layout;
        ColourView::new(self.bytes(), width, height, stride).map_err(invalid_input)
    }

    /// The bytes from the first pixel to the last, those between the rows included.
    fn bytes(&self) -> &[u8] {
        if self.layout.bytes == 0 {
            return &[];
        }
        // SAFETY: `new` checked that the elements are single bytes, and `Layout::of` that all
        // strides lead forward; so the first pixel has the lowest address and the last pixel's last
        // byte is `layout.bytes` − 1 further, which does not overflow. NumPy keeps everything
        // between two elements of an array in one allocation, initialised as far as bytes go. (An
        // array that `as_strided` makes point elsewhere is unsound for NumPy itself.) `self.array`
        // holds a counted reference to the array, so that the memory outlives the slice.
        // The memory must not be written to meanwhile. `self.array` is a shared borrow, which keeps
        // Rust code that borrows NumPy arrays from writing to these pixels (the bytes between two
        // rows may belong to another view, but are never read). Python code in another thread could
        // write; no Rust binding to NumPy can prevent that, and the documentation of the module
        // forbids it. It would corrupt this frame only: any byte is a valid pixel, and the core
        // checks every index.
        #[expect(unsafe_code, reason = "rows with gaps have no safe slice; see SAFETY")]
        unsafe {
            std::slice::from_raw_parts(self.array.data(), self.layout.bytes)
        }
    }
}

impl Layout {
    /// The layout, if the bytes of a row are contiguous and each row begins at or after the end of
    /// the one before. (The stride of an axis with at most one entry may be anything, and so may
    /// all strides of an empty array.) The shape fits the pixel.
    fn of(shape: &[usize], strides: &[isize], pixel: Pixel) -> Option<Self> {
        let (height, width) = (shape[0], shape[1]);
        let row = width.checked_mul(pixel.bytes())?;
        if height == 0 || width == 0 {
            return Some(Self { width, height, stride: row, bytes: 0 });
        }
        let pixels_adjoin = width == 1 || strides[1] == pixel.bytes() as isize;
        let channels_adjoin = strides.get(2).is_none_or(|&channel| channel == 1);
        let stride = if height == 1 { row } else { usize::try_from(strides[0]).ok()? };
        if !pixels_adjoin || !channels_adjoin || stride < row {
            return None;
        }
        let bytes = (height - 1).checked_mul(stride)?.checked_add(row)?;
        isize::try_from(bytes).ok()?;
        Some(Self { width, height, stride, bytes })
    }
}

fn refused(what: &str, given: &Bound<'_, PyAny>, needed: &str) -> PyErr {
    let given = match given.cast::<PyUntypedArray>() {
        Ok(array) => format!(
            "an array of dtype {}, shape {} and strides {}",
            array.dtype(),
            as_tuple(array.shape()),
            as_tuple(array.strides())
        ),
        Err(_) => format!("of {}", given.get_type()),
    };
    InvalidInputError::new_err(format!("{what} is {given}; it must be {needed}"))
}
