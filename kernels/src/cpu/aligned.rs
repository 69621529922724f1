//! A cache-line-aligned buffer of `f32`.
use std::alloc::{Layout, alloc_zeroed, dealloc, handle_alloc_error};
use std::ops::{Deref, DerefMut};
use std::ptr::NonNull;

/// Bytes of a cache line and of the widest vector.
const ALIGN: usize = 64;

/// A zero-initialised `f32` buffer whose first element is 64-byte aligned. Pages of a large one take no memory
/// before they are written.
#[derive(Debug)]
pub struct AlignedVec {
    /// An allocation of `layout(len)`, or dangling when `len == 0`. It is not aligned: the allocator hands out untouched
    /// pages only where nothing is asked of their address.
    base: NonNull<u8>,
    /// The first aligned address inside.
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
        AlignedVec::try_zeroed(len).unwrap_or_else(|| match Self::layout(len) {
            Some(layout) => handle_alloc_error(layout),
            None => panic!("buffer size overflows"),
        })
    }

    /// The same; `None` if there is no memory for it.
    pub fn try_zeroed(len: usize) -> Option<AlignedVec> {
        if len == 0 {
            return Some(AlignedVec { base: NonNull::dangling(), ptr: NonNull::dangling(), len });
        }
        // SAFETY: the layout has a nonzero size because `len > 0`.
        let base = NonNull::new(unsafe { alloc_zeroed(Self::layout(len)?) })?;
        // SAFETY: less than `ALIGN` bytes on, of which the allocation has so many more than `len` floats.
        let ptr = unsafe { base.add(base.addr().get().next_multiple_of(ALIGN) - base.addr().get()) };
        Some(AlignedVec { base, ptr: ptr.cast(), len })
    }

    /// Grows to at least `len` elements, all zeros if it was shorter. Whether there was memory for it: else it is as before.
    pub fn try_grow(&mut self, len: usize) -> bool {
        let larger = if len > self.len { AlignedVec::try_zeroed(len) } else { return true };
        larger.map(|larger| *self = larger).is_some()
    }

    pub fn as_ptr(&self) -> *const f32 {
        self.ptr.as_ptr()
    }

    pub fn as_mut_ptr(&mut self) -> *mut f32 {
        self.ptr.as_ptr()
    }

    /// Room for `len` floats at an aligned address, unless it is larger than any memory.
    fn layout(len: usize) -> Option<Layout> {
        let bytes = len.checked_mul(size_of::<f32>())?.checked_add(ALIGN)?;
        Layout::from_size_align(bytes, align_of::<f32>()).ok()
    }
}

impl Drop for AlignedVec {
    fn drop(&mut self) {
        if self.len > 0
            && let Some(layout) = Self::layout(self.len)
        {
            // SAFETY: `len > 0`, so `base` came from `alloc_zeroed` with this very layout and is freed only here.
            unsafe { dealloc(self.base.as_ptr(), layout) }
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
    fn is_zeroed_and_aligned() {
        let mut v = AlignedVec::zeroed(5);
        assert_eq!(v.as_ptr() as usize % ALIGN, 0);
        assert_eq!(&v[..], &[0.0; 5]);
        v[4] = 7.0;
        assert!(v.try_grow(1000));
        assert_eq!(v.as_ptr() as usize % ALIGN, 0);
        assert_eq!(&v[..], &[0.0; 1000]);
        v[4] = 7.0;
        assert!(v.try_grow(3) && !v.try_grow(usize::MAX));
        assert_eq!((v.len(), v.clone()[4]), (1000, 7.0));
        assert!(AlignedVec::default().is_empty());
        for too_many in [1 << 58, usize::MAX / 4, usize::MAX] {
            assert!(AlignedVec::try_zeroed(too_many).is_none());
        }
    }
}
