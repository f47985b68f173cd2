//! Memory that the host and the translated code share.

use std::alloc::{alloc, dealloc, handle_alloc_error, Layout};
use std::ptr::NonNull;

/// The translator maps whole pages only.
pub const PAGE: u32 = 4096;

/// A block of host memory at a fixed address, page aligned.
///
/// Translated code writes to it through a raw pointer, so no Rust reference to it may live while
/// code runs: [`Self::bytes`] and [`Self::bytes_mut`] borrow the owner, and the owner is not
/// reachable then.
pub struct HostMemory {
    start: NonNull<u8>,
    layout: Layout,
}

impl HostMemory {
    /// `len` bytes, each `fill`. `len` is a multiple of [`PAGE`].
    #[must_use]
    pub fn new(len: u32, fill: u8) -> Self {
        assert!(len > 0 && len.is_multiple_of(PAGE), "memory blocks are whole pages");
        let layout = Layout::from_size_align(len as usize, PAGE as usize).expect("a valid layout");
        // SAFETY: the layout's size is not zero, as asserted above.
        let Some(start) = NonNull::new(unsafe { alloc(layout) }) else { handle_alloc_error(layout) };
        // SAFETY: the allocation is `len` bytes long and nobody else knows it yet.
        unsafe { start.as_ptr().write_bytes(fill, len as usize) };
        Self { start, layout }
    }

    /// Where it lies in the host.
    #[must_use]
    pub fn as_ptr(&self) -> *mut u8 {
        self.start.as_ptr()
    }

    /// Length in bytes.
    #[must_use]
    pub fn size(&self) -> usize {
        self.layout.size()
    }

    /// What it holds.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        // SAFETY: the block is allocated and initialised as long as `self` lives; the type's rule
        // keeps writers away.
        unsafe { std::slice::from_raw_parts(self.start.as_ptr(), self.size()) }
    }

    /// The content, for changes. A caller that changes code must notify the translator.
    #[must_use]
    pub fn bytes_mut(&mut self) -> &mut [u8] {
        // SAFETY: as in `bytes`, and `&mut self` makes the slice the only way in.
        unsafe { std::slice::from_raw_parts_mut(self.start.as_ptr(), self.size()) }
    }
}

impl Drop for HostMemory {
    fn drop(&mut self) {
        // SAFETY: allocated in `new` with this layout.
        unsafe { dealloc(self.start.as_ptr(), self.layout) }
    }
}
