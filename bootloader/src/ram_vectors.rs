//! The vector table in RAM: the core fetches vectors from flash otherwise, and stalls there while
//! flash is busy.

use core::cell::UnsafeCell;

use cortex_m::peripheral::SCB;

/// Entries of the F4's largest table: 16 exceptions and up to 112 interrupts, rounded up to VTOR's
/// alignment.
const ENTRIES: usize = 128;

#[repr(C, align(512))]
struct Vectors(UnsafeCell<[u32; ENTRIES]>);

// SAFETY: written once, by `relocate`, before interrupts are on; only the core reads it afterwards.
unsafe impl Sync for Vectors {}

#[link_section = ".ram_vectors"]
static VECTORS: Vectors = Vectors(UnsafeCell::new([0; ENTRIES]));

extern "C" {
    static __vector_table: [u32; ENTRIES];
}

/// Copies the table from flash to RAM and points the core to the copy.
///
/// Call it once, with interrupts off.
pub fn relocate(scb: &mut SCB) {
    // SAFETY: the linker script lays the table down at the start of the flash, of which `ENTRIES`
    // words can be read, and no chip's table is longer; what stands behind a shorter one is
    // nobody's vector. Interrupts are off, so nothing reads the copy while it is made.
    unsafe {
        let copy = VECTORS.0.get();
        copy.copy_from_nonoverlapping(&raw const __vector_table, 1);
        scb.vtor.write(copy as u32);
    }
    cortex_m::asm::dsb();
    cortex_m::asm::isb();
}
