//! Asking for memory before it is needed.
//!
//! The greedy loops visit a mesh in the order of their queues, which is none that a processor could
//! foresee; but a queue knows what it will hand out soon.

/// Begins to load an element of a slice into the cache, if there is one. Changes nothing.
#[inline(always)]
pub(crate) fn prefetch<T>(slice: &[T], index: usize) {
    #[cfg(target_arch = "x86_64")]
    if let Some(element) = slice.get(index) {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        let first = std::ptr::from_ref(element).cast::<i8>();
        let last = first.wrapping_add(size_of::<T>().saturating_sub(1));
        #[allow(unsafe_code, reason = "prefetching reads nothing: any address will do")]
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
