//! One source, compiled for several instruction sets, and the choice among them at run time; and
//! loads from many places, their bounds checked together.
//!
//! The lanes are plain loops over arrays, which the compiler turns into vector instructions; which
//! ones it may use is decided by the function that they are inlined into. There is one such
//! function per instruction set here.
//!
//! All unsafe code of the crate is in this file: a call that needs the processor to have what it
//! has just been found to have, and loads that need their places to be inside.

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]

use std::fmt;

/// An instruction set that searches can be compiled for. All give the same bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Isa {
    /// One line at a time: the reference for the others.
    Scalar,
    /// What every processor of the architecture has: SSE2 on x86-64, NEON on AArch64.
    Baseline,
    /// AVX2 on x86-64.
    Avx2,
}

impl Isa {
    /// The widest that this processor has.
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

    /// All that this processor has.
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
    /// Does it. Implementations, and all that they call, are `#[inline(always)]`, or they would be
    /// compiled for the baseline alone.
    fn run(self);
}

impl Isa {
    /// Does `work` with this instruction set, or with the baseline where the processor lacks it.
    #[inline]
    pub(crate) fn run(self, work: impl Work) {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 if is_x86_feature_detected!("avx2") => {
                #[expect(
                    unsafe_code,
                    reason = "AVX2 saves a third of a search; see the benchmark `ratios`"
                )]
                // SAFETY: `avx2` is unsafe to call only on a processor without AVX2; this one has
                // it, as the guard of this arm has just made sure.
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

/// Fills every cell with the two bytes that begin at its place, the first one lowest, and with the
/// two that begin `stride` bytes later; with zeros if one of the places is too near to the end of
/// `bytes`.
#[inline(always)]
pub(crate) fn gather_cells<const N: usize>(
    bytes: &[u8],
    stride: usize,
    places: &[[u32; N]],
    cells: &mut [[[u16; N]; 2]],
) {
    let lower = bytes.get(stride..).unwrap_or_default();
    if furthest(places) + 2 > lower.len() as u64 {
        cells.fill([[0; N]; 2]);
        return;
    }
    for (places, [above, below]) in places.iter().zip(cells) {
        for j in 0..N {
            let at = places[j] as usize;
            #[expect(
                unsafe_code,
                reason = "checked one by one, the loads make a search a quarter longer"
            )]
            // SAFETY: at + 2 ≤ furthest(places) + 2 ≤ lower.len() ≤ bytes.len(), as was checked in
            // 64 bits, which the sum of a place, of 32 bits, and 2 does not overflow. An array of
            // bytes needs no alignment.
            let pairs =
                unsafe { [bytes, lower].map(|row| row.as_ptr().add(at).cast::<[u8; 2]>().read()) };
            [above[j], below[j]] = pairs.map(u16::from_le_bytes);
        }
    }
}

/// Replaces every place by the four bytes that begin there, the first one lowest; beyond the end
/// of `bytes` there are zeros.
#[inline(always)]
pub(crate) fn gather_words<const N: usize>(bytes: &[u8], places: &mut [[u32; N]]) {
    if furthest(places) + 4 > bytes.len() as u64 {
        for place in places.as_flattened_mut() {
            let four = bytes.get(*place as usize..).unwrap_or_default().iter().take(4);
            *place = four.rev().fold(0, |word, &byte| (word << 8) | u32::from(byte));
        }
        return;
    }
    for place in places.as_flattened_mut() {
        #[expect(unsafe_code, reason = "as for cells")]
        // SAFETY: place + 4 ≤ furthest(places) + 4 ≤ bytes.len(), as for cells.
        let four = unsafe { bytes.as_ptr().add(*place as usize).cast::<[u8; 4]>().read() };
        *place = u32::from_le_bytes(four);
    }
}

#[inline(always)]
fn furthest<const N: usize>(places: &[[u32; N]]) -> u64 {
    let mut furthest = [0; N];
    for places in places {
        for j in 0..N {
            furthest[j] = places[j].max(furthest[j]);
        }
    }
    furthest.into_iter().fold(0, u32::max).into()
}
