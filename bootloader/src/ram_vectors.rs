//! The vector table in RAM: the core fetches vectors from flash otherwise, and stalls there while flash is busy.

use core::cell::UnsafeCell;

use cortex_m::peripheral::SCB;

/// Entries of the F4's largest table: 16 exceptions and up to 112 interrupts, rounded up to VTOR's alignment.
const ENTRIES: usize = 128;

#[repr(C, align(512))]
struct Vectors(UnsafeCell<[u32; ENTRIES]>);

// SAFETY: written once, by `relocate`, before interrupts are on; only the core reads it afterwards.
unsafe impl Sync for Vectors {}

#[link_section = ".ram_vectors"]
static VECTORS: Vectors = Vectors(UnsafeCell::new([0; ENTRIES]));

extern "C" {
    static __vector_table: u32;
    static __vector_table_end: u32;
}

/// Copies the table from flash to RAM and points the core to the copy.
///
/// Call it once, with interrupts off.
pub fn relocate(scb: &mut SCB) {
    // SAFETY: the two symbols border the table that the linker script lays down; the chip's table has no more than
    // `ENTRIES` entries (`min` holds even if it had); interrupts are off, so nothing reads the copy while it is made.
    unsafe {
        let table = &raw const __vector_table;
        let count = (&raw const __vector_table_end).offset_from_unsigned(table).min(ENTRIES);
        let copy = VECTORS.0.get().cast::<u32>();
        copy.copy_from_nonoverlapping(table, count);
        scb.vtor.write(copy as u32);
    }
    cortex_m::asm::dsb();
    cortex_m::asm::isb();
}
