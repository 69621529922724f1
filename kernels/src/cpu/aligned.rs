//! A cache-line-aligned buffer of `f32`.
use std::alloc::{Layout, alloc, dealloc, handle_alloc_error};
use std::ops::{Deref, DerefMut};
use std::ptr::NonNull;

/// Bytes of a cache line and of the widest vector.
const ALIGN: usize = 64;
/// Bytes of a huge page. Buffers of at least half of one are made of them: a tile's channels lie far apart, so that a
/// layer touches more small pages than the processor remembers the addresses of.
const HUGE_PAGE: usize = 2 << 20;

/// A zero-initialised, growable `f32` buffer whose first element is 64-byte aligned.
#[derive(Debug)]
pub struct AlignedVec {
    /// Start of an allocation of `layout(len)`, or dangling when `len == 0`.
    ptr: NonNull<f32>,
    len: usize,
}

// SAFETY: the buffer owns its allocation and `f32` is plain data, so moving it to another thread and sharing
// `&AlignedVec` are as safe as for `Vec<f32>`.
unsafe impl Send for AlignedVec {}
// SAFETY: see above.
unsafe impl Sync for AlignedVec {}

impl AlignedVec {
    /// A buffer of `len` zeros.
    pub fn zeroed(len: usize) -> AlignedVec {
        if len == 0 {
            return AlignedVec { ptr: NonNull::dangling(), len };
        }
        let layout = Self::layout(len);
        // SAFETY: `layout` has a nonzero size because `len > 0`.
        let raw = unsafe { alloc(layout) };
        let Some(ptr) = NonNull::new(raw.cast::<f32>()) else { handle_alloc_error(layout) };
        #[cfg(target_os = "linux")]
        if layout.align() == HUGE_PAGE {
            // SAFETY: whole pages of this very allocation; the advice changes no content. It may be declined.
            unsafe { libc::madvise(raw.cast(), layout.size(), libc::MADV_HUGEPAGE) };
        }
        // SAFETY: `len` floats were allocated. After the advice, since the first touch decides the kind of a page.
        unsafe { ptr.write_bytes(0, len) };
        AlignedVec { ptr, len }
    }

    /// Grows to at least `len` elements; keeps the old contents, new elements are zero.
    pub fn grow(&mut self, len: usize) {
        if len > self.len {
            let mut larger = AlignedVec::zeroed(len);
            larger[..self.len].copy_from_slice(self);
            *self = larger;
        }
    }

    pub fn as_ptr(&self) -> *const f32 {
        self.ptr.as_ptr()
    }

    pub fn as_mut_ptr(&mut self) -> *mut f32 {
        self.ptr.as_ptr()
    }

    fn layout(len: usize) -> Layout {
        let bytes = len.checked_mul(size_of::<f32>()).expect("buffer size overflows");
        let align = if bytes >= HUGE_PAGE / 2 { HUGE_PAGE } else { ALIGN };
        Layout::from_size_align(bytes, align).expect("buffer size overflows").pad_to_align()
    }
}

impl Drop for AlignedVec {
    fn drop(&mut self) {
        if self.len > 0 {
            // SAFETY: `len > 0`, so `ptr` came from `alloc_zeroed` with this very layout and is freed only here.
            unsafe { dealloc(self.ptr.as_ptr().cast(), Self::layout(self.len)) }
        }
    }
}

impl Deref for AlignedVec {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        // SAFETY: `ptr` is valid for `len` initialised floats (or dangling, aligned and `len == 0`).
        unsafe { std::slice::from_raw_parts(self.ptr.as_ptr(), self.len) }
    }
}

impl DerefMut for AlignedVec {
    fn deref_mut(&mut self) -> &mut [f32] {
        // SAFETY: as in `deref`, and `&mut self` makes the access exclusive.
        unsafe { std::slice::from_raw_parts_mut(self.ptr.as_ptr(), self.len) }
    }
}

impl Clone for AlignedVec {
    fn clone(&self) -> Self {
        AlignedVec::from(&self[..])
    }
}

impl From<&[f32]> for AlignedVec {
    fn from(values: &[f32]) -> Self {
        let mut out = AlignedVec::zeroed(values.len());
        out.copy_from_slice(values);
        out
    }
}

impl Default for AlignedVec {
    fn default() -> Self {
        AlignedVec::zeroed(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn is_zeroed_aligned_and_keeps_its_contents() {
        let mut v = AlignedVec::zeroed(5);
        assert_eq!(v.as_ptr() as usize % ALIGN, 0);
        assert_eq!(&v[..], &[0.0; 5]);
        v[4] = 7.0;
        v.grow(1000);
        assert_eq!(v.as_ptr() as usize % ALIGN, 0);
        assert_eq!((v.len(), v[4], v[999]), (1000, 7.0, 0.0));
        v.grow(3);
        assert_eq!(v.clone().len(), 1000);
        assert!(AlignedVec::default().is_empty());
    }
}
