//! One source compiled for several instruction sets, selected at run time; and loads from many
//! addresses with a common bounds check.
//!
//! The lanes are plain loops over arrays, which the compiler turns into vector instructions. The
//! instructions available to it are determined by the function that they are inlined into. There is
//! one such function per instruction set here.
//!
//! All unsafe code of the crate is in this file: calls that require processor features that were
//! detected before, and loads that require addresses inside a slice.

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]

use std::fmt;

/// An instruction set for which searches are compiled. All give the same bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Isa {
    /// One line at a time: the reference for the others.
    Scalar,
    /// The minimum of the architecture: SSE2 on x86-64, NEON on AArch64.
    Baseline,
    /// AVX2 on x86-64.
    Avx2,
}

impl Isa {
    /// The widest of this processor.
    #[must_use]
    pub fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") {
            return Self::Avx2;
        }
        Self::Baseline
    }

    /// Whether this processor has it.
    #[must_use]
    pub fn is_available(self) -> bool {
        match self {
            Self::Scalar | Self::Baseline => true,
            Self::Avx2 => Self::detect() == Self::Avx2,
        }
    }

    /// All instruction sets of this processor.
    pub fn available() -> impl Iterator<Item = Self> {
        [Self::Scalar, Self::Baseline, Self::Avx2].into_iter().filter(|isa| isa.is_available())
    }
}

impl fmt::Display for Isa {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Scalar => "scalar",
            Self::Baseline if cfg!(target_arch = "x86_64") => "SSE2",
            Self::Baseline if cfg!(target_arch = "aarch64") => "NEON",
            Self::Baseline => "baseline",
            Self::Avx2 => "AVX2",
        })
    }
}

/// Work that is compiled for every instruction set.
pub(crate) trait Work {
    /// Performs the work. Implementations, and all functions they call, are `#[inline(always)]`;
    /// otherwise they would be compiled for the baseline alone.
    fn run(self);
}

impl Isa {
    /// Performs `work` with this instruction set, or with the baseline if the processor lacks it.
    #[inline]
    pub(crate) fn run(self, work: impl Work) {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 if is_x86_feature_detected!("avx2") => {
                #[expect(
                    unsafe_code,
                    reason = "AVX2 saves a third of a search; see the benchmark `ratios`"
                )]
                // SAFETY: `avx2` is unsafe to call only on a processor without AVX2; the guard of
                // this arm has just checked that this one has it.
                unsafe {
                    avx2(work);
                }
            }
            _ => work.run(),
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn avx2(work: impl Work) {
    work.run();
}

/// One number for every lane.
#[inline(always)]
pub(crate) fn each<T: Copy + Default, const N: usize>(of: impl Fn(usize) -> T) -> [T; N] {
    // Not `array::from_fn`, which is not always inlined.
    let mut lanes = [T::default(); N];
    for (j, lane) in lanes.iter_mut().enumerate() {
        *lane = of(j);
    }
    lanes
}

/// Number of 16-bit lanes of the baseline's vectors.
pub(crate) const BASELINE_LANES: usize = 8;

/// Layout of an image's pixels in memory.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Layout {
    /// Bytes from one row to the next.
    pub stride: u32,
    /// Bytes from one column to the next.
    pub pitch: u32,
}

/// Addresses of the samples of lines: lane j of every vector belongs to line j.
#[derive(Debug, Clone)]
pub(crate) struct Places<const N: usize> {
    places: Vec<[u32; N]>,
    /// Upper bound on all addresses.
    furthest: u64,
}

impl<const N: usize> Places<N> {
    /// Capacity for `samples` samples of every line.
    pub fn with_capacity(samples: usize) -> Self {
        Self { places: Vec::with_capacity(samples), furthest: 0 }
    }

    /// Sets the addresses of `samples` samples of every line, at least one, from `start` on and
    /// `step` apart, in (column, row) of 16.16 fixed point. If a coordinate is negative or not
    /// below 32768, nothing will be read.
    #[inline(always)]
    pub fn locate(
        &mut self,
        start: [[i32; N]; 2],
        step: [[i32; N]; 2],
        samples: usize,
        layout: Layout,
    ) {
        self.furthest = furthest(&start, &step, samples, layout);
        self.places.resize(samples, [0; N]);
        #[cfg(target_arch = "x86_64")]
        if let (BASELINE_LANES, Some(factors)) = (N, sse2::factors(layout)) {
            #[expect(unsafe_code, reason = "with SSE2 it saves a twentieth of an iteration")]
            // SAFETY: every x86-64 has SSE2.
            self.walk(start, step, |x, y| unsafe { sse2::places(x, y, factors) });
            return;
        }
        let Layout { stride, pitch } = layout;
        self.walk(start, step, |x, y| {
            each(|j| {
                let (row, column) = ((y[j] >> 16) as u32, (x[j] >> 16) as u32);
                row.wrapping_mul(stride).wrapping_add(column.wrapping_mul(pitch))
            })
        });
    }

    /// Sets all addresses, sample by sample; `places` computes them from columns and rows.
    #[inline(always)]
    fn walk(
        &mut self,
        [mut x, mut y]: [[i32; N]; 2],
        [dx, dy]: [[i32; N]; 2],
        places: impl Fn(&[i32; N], &[i32; N]) -> [u32; N],
    ) {
        for sample in &mut self.places {
            *sample = places(&x, &y);
            // The mask leaves non-negative coordinates unchanged. It keeps the compiler from
            // processing several samples of one line at once, lane after lane.
            x = each(|j| x[j].wrapping_add(dx[j]) & i32::MAX);
            y = each(|j| y[j].wrapping_add(dy[j]) & i32::MAX);
        }
    }

    /// The pixels about the addresses, sample by sample, in `bytes` with rows `stride` apart;
    /// `None` if an address may be too near to the end.
    #[inline(always)]
    pub fn cells<'a>(&'a self, bytes: &'a [u8], stride: usize) -> Option<Cells<'a, N>> {
        self.read_by(bytes, stride, 2)
    }

    /// The same by loads of four bytes, where these are faster: with SSE2 alone.
    #[inline(always)]
    pub fn wide_cells<'a>(&'a self, bytes: &'a [u8], stride: usize) -> Option<WideCells<'a, N>> {
        let has_sse2_alone = cfg!(target_arch = "x86_64") && N == BASELINE_LANES;
        has_sse2_alone.then(|| self.read_by(bytes, stride, 4).map(WideCells))?
    }

    /// Cells of which `reach` bytes may be read from every address on.
    #[inline(always)]
    fn read_by<'a>(&'a self, bytes: &'a [u8], stride: usize, reach: u64) -> Option<Cells<'a, N>> {
        let lower = bytes.get(stride..)?;
        let all_inside = self.furthest.saturating_add(reach) <= lower.len() as u64;
        all_inside.then_some(Cells { places: self.places.iter(), upper: bytes, lower })
    }

    /// Replaces every address by the four bytes that begin there, the first one lowest; zeros
    /// beyond the end of `bytes`.
    #[inline(always)]
    pub fn read_words(&mut self, bytes: &[u8]) {
        let furthest = std::mem::replace(&mut self.furthest, u64::MAX);
        if furthest.saturating_add(4) > bytes.len() as u64 {
            for place in self.places.as_flattened_mut() {
                let four = bytes.get(*place as usize..).unwrap_or_default().iter().take(4);
                *place = four.rev().fold(0, |word, &byte| (word << 8) | u32::from(byte));
            }
            return;
        }
        for place in self.places.as_flattened_mut() {
            #[expect(unsafe_code, reason = "as for cells")]
            // SAFETY: place + 4 ≤ furthest + 4 ≤ bytes.len(), as was checked. Afterwards no address
            // is left that `furthest` bounds, and it is reset accordingly.
            let four = unsafe { bytes.as_ptr().add(*place as usize).cast::<[u8; 4]>().read() };
            *place = u32::from_le_bytes(four);
        }
    }

    /// The words that were read; the addresses have been overwritten.
    #[inline(always)]
    pub fn words_mut(&mut self) -> &mut [[u32; N]] {
        self.furthest = u64::MAX;
        &mut self.places
    }
}

/// For every sample the two bytes at its address, the first one lowest, and the two bytes a row
/// later.
pub(crate) struct Cells<'a, const N: usize> {
    /// Every address is at least 2 bytes before the end of `lower`, which is no longer than
    /// `upper`.
    places: std::slice::Iter<'a, [u32; N]>,
    upper: &'a [u8],
    lower: &'a [u8],
}

impl<const N: usize> Iterator for Cells<'_, N> {
    type Item = [[u16; N]; 2];

    #[inline(always)]
    fn next(&mut self) -> Option<Self::Item> {
        let places = self.places.next()?;
        let mut cells = [[0; N]; 2];
        for (cells, bytes) in cells.iter_mut().zip([self.upper, self.lower]) {
            *cells = each(|j| {
                let pair = bytes.as_ptr().wrapping_add(places[j] as usize).cast::<[u8; 2]>();
                #[expect(
                    unsafe_code,
                    reason = "checked one by one, the loads make a search a quarter longer"
                )]
                // SAFETY: places[j] + 2 ≤ lower.len() ≤ upper.len(), as checked by `Places::cells`.
                // An array of bytes needs no alignment.
                let pair = unsafe { pair.read() };
                u16::from_le_bytes(pair)
            });
        }
        Some(cells)
    }
}

/// The same with every address at least 4 bytes before the end of `lower`.
pub(crate) struct WideCells<'a, const N: usize>(Cells<'a, N>);

impl<const N: usize> Iterator for WideCells<'_, N> {
    type Item = [[u16; N]; 2];

    #[cfg(target_arch = "x86_64")]
    #[inline(always)]
    fn next(&mut self) -> Option<Self::Item> {
        let Cells { places, upper, lower } = &mut self.0;
        let places = places.next()?;
        let mut cells = [[0; N]; 2];
        for (cells, bytes) in cells.iter_mut().zip([*upper, *lower]) {
            #[expect(unsafe_code, reason = "an iteration takes a fifth less time with SSE2")]
            // SAFETY: places[j] + 4 ≤ lower.len() ≤ upper.len(), as checked by
            // `Places::wide_cells`. Every x86-64 has SSE2.
            unsafe {
                *cells = sse2::pairs(bytes, places);
            }
        }
        Some(cells)
    }

    #[cfg(not(target_arch = "x86_64"))]
    #[inline(always)]
    fn next(&mut self) -> Option<Self::Item> {
        self.0.next()
    }
}

/// Operations for which a compiler needs many instructions of SSE2, written in few. For wider sets
/// it selects better ones itself.
#[cfg(target_arch = "x86_64")]
mod sse2 {
    use super::Layout;
    use std::arch::x86_64::{
        __m128i, _mm_and_si128, _mm_cvtsi32_si128, _mm_madd_epi16, _mm_or_si128, _mm_set1_epi32,
        _mm_setr_epi32, _mm_srli_epi32, _mm_unpacklo_epi16, _mm_unpacklo_epi32, _mm_unpacklo_epi64,
    };
    use std::mem::transmute;

    /// The bytes of a row and of a column, in the upper and the lower half of a word; `None` if the
    /// rows are too long for that.
    pub fn factors(layout: Layout) -> Option<i32> {
        let [stride, pitch] = [layout.stride, layout.pitch].map(i16::try_from);
        Some((i32::from(stride.ok()?) << 16) | i32::from(pitch.ok()?))
    }

    /// Addresses for columns and rows in 16.16 fixed point, of a multiple of four lines.
    #[target_feature(enable = "sse2")]
    #[inline]
    pub fn places<const N: usize>(x: &[i32; N], y: &[i32; N], factors: i32) -> [u32; N] {
        let (rows, factors) = (_mm_set1_epi32(-1 << 16), _mm_set1_epi32(factors));
        let mut places = [0; N];
        let (x, y) = (x.as_chunks().0, y.as_chunks().0);
        for (places, (&x, &y)) in places.as_chunks_mut().0.iter_mut().zip(x.iter().zip(y)) {
            let vector = |of: [i32; 4]| _mm_setr_epi32(of[0], of[1], of[2], of[3]);
            let column = _mm_srli_epi32(vector(x), 16);
            let both = _mm_or_si128(column, _mm_and_si128(vector(y), rows));
            *places = words(_mm_madd_epi16(both, factors));
        }
        places
    }

    /// The two bytes at every address, the first one lowest, of a multiple of eight lines.
    ///
    /// # Safety
    /// `places[j] + 4 <= bytes.len()` of all j.
    #[expect(unsafe_code, reason = "all four are inside, as the caller has made sure")]
    #[target_feature(enable = "sse2")]
    #[inline]
    pub unsafe fn pairs<const N: usize>(bytes: &[u8], places: &[u32; N]) -> [u16; N] {
        let mut pairs = [0; N];
        for (pairs, places) in pairs.as_chunks_mut().0.iter_mut().zip(places.as_chunks::<8>().0) {
            // A load of four bytes into a vector takes one instruction, of two bytes two.
            let four = |place: u32| {
                let four = bytes.as_ptr().wrapping_add(place as usize).cast::<[u8; 4]>();
                // SAFETY: place + 4 ≤ bytes.len(). An array of bytes needs no alignment.
                i32::from_le_bytes(unsafe { four.read() })
            };
            let word = |j: usize| _mm_cvtsi32_si128(four(places[j]));
            let two = |j| _mm_unpacklo_epi16(word(j), word(j + 1));
            let four = |j| _mm_unpacklo_epi32(two(j), two(j + 2));
            *pairs = halves(_mm_unpacklo_epi64(four(0), four(4)));
        }
        pairs
    }

    #[target_feature(enable = "sse2")]
    #[inline]
    fn words(vector: __m128i) -> [u32; 4] {
        #[expect(unsafe_code, reason = "there is no other way between a vector and an array")]
        // SAFETY: both are sixteen bytes, of which any values are valid.
        unsafe {
            transmute(vector)
        }
    }

    #[target_feature(enable = "sse2")]
    #[inline]
    fn halves(vector: __m128i) -> [u16; 8] {
        #[expect(unsafe_code, reason = "there is no other way between a vector and an array")]
        // SAFETY: both are sixteen bytes, of which any values are valid.
        unsafe {
            transmute(vector)
        }
    }
}

/// Upper bound on the addresses of samples on lines, or `u64::MAX` if there is none.
///
/// Coordinates along a line lie between those of its ends, and so do their whole parts; the address
/// of the last column of the last row bounds all. If the ends are not negative, the steps are short
/// enough that no multiple of them overflows, and the bound fits 32 bits, 32-bit arithmetic is
/// exact.
#[inline(always)]
fn furthest<const N: usize>(
    start: &[[i32; N]; 2],
    step: &[[i32; N]; 2],
    samples: usize,
    layout: Layout,
) -> u64 {
    let Ok(steps) = i32::try_from(samples) else { return u64::MAX };
    let longest = i32::MAX / steps.max(1);
    let mut invalid = [0; N];
    let mut far = [[0; N]; 2];
    for axis in 0..2 {
        let (start, step) = (&start[axis], &step[axis]);
        let end: [i32; N] = each(|j| start[j].wrapping_add(step[j].wrapping_mul(steps - 1)));
        // Negative numbers have the highest bit set. The sum of two non-negative numbers, one of
        // which is an end, overflows into it.
        invalid = each(|j| invalid[j] | start[j] | end[j] | (longest - step[j].saturating_abs()));
        far[axis] = each(|j| start[j].max(end[j]));
    }
    let invalid = invalid.iter().fold(0, |any, one| any | one);
    let [column, row] = far.map(|far| (far.into_iter().fold(0, i32::max) >> 16) as u64);
    let place = row * u64::from(layout.stride) + column * u64::from(layout.pitch);
    if invalid < 0 || place > u64::from(u32::MAX) { u64::MAX } else { place }
}
