//! What only the processor can do, and what is `unsafe` for that: the one such place of the project.
//!
//! Invariants:
//! 1. results are the same with and without it, on any processor;
//! 2. what is `unsafe` here takes no promise from its caller.

/// Begins to load an element of a slice into the cache, if there is one. Changes nothing.
///
/// The greedy loops visit a mesh in the order of their queues, which is none that a processor could
/// foresee; but a queue knows what it will hand out soon.
#[inline(always)]
pub(crate) fn prefetch<T>(slice: &[T], index: usize) {
    #[cfg(target_arch = "x86_64")]
    if let Some(element) = slice.get(index) {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        let first = std::ptr::from_ref(element).cast::<i8>();
        let last = first.wrapping_add(size_of::<T>().saturating_sub(1));
        #[allow(unsafe_code, reason = "there is no safe way to load without waiting")]
        // SAFETY: prefetching reads nothing, any address will do.
        unsafe {
            _mm_prefetch::<_MM_HINT_T0>(first);
            // Elements of more than a cache line have two of them, or lie across three.
            if size_of::<T>() > size_of::<[u64; 8]>() {
                _mm_prefetch::<_MM_HINT_T0>(last);
            }
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (slice, index);
}

/// Defines a function that calls `$avx2`, which is compiled for AVX2, where the processor has that,
/// and `$plain` elsewhere.
macro_rules! by_processor {
    (
        $(#[$attribute:meta])*
        $visibility:vis fn $name:ident $(<const $N:ident: usize>)? ($($argument:ident: $type:ty),*) -> $out:ty {
            avx2: $avx2:path,
            plain: $plain:path $(,)?
        }
    ) => {
        $(#[$attribute])*
        $visibility fn $name $(<const $N: usize>)? ($($argument: $type),*) -> $out {
            #[cfg(target_arch = "x86_64")]
            if is_x86_feature_detected!("avx2") {
                // Not `unsafe` itself: it compiles only if `$avx2` needs no more than AVX2.
                #[target_feature(enable = "avx2")]
                fn with_avx2 $(<const $N: usize>)? ($($argument: $type),*) -> $out {
                    $avx2($($argument),*)
                }
                #[allow(unsafe_code, reason = "the processor was asked for AVX2 just above")]
                // SAFETY: the function needs AVX2 and nothing else, and the processor has it.
                return unsafe { with_avx2($($argument),*) };
            }
            $plain($($argument),*)
        }
    };
}
pub(crate) use by_processor;
