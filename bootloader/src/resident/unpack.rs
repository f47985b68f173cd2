//! The unpacker of ZX0 streams (format version 2, Einar Saukas) with our own offsets
//! (`shared_abi::ram_image::Method`). It is in assembly: half as long and three times as fast as
//! compiled Rust code. Its speed matters, because it runs between the call of the bootloader and
//! the answer.
//!
//! A stream consists of literals and copies in turn. Flags and numbers are bits; the bits are in
//! bytes between the other bytes. Literals and the lower parts of offsets are bytes. A number is an
//! interlaced Elias gamma code: it starts as 1; for each further binary digit come a 0 and the
//! digit, which is shifted in; a 1 ends it.

use core::arch::global_asm;

extern "C" {
    fn zx0_unpack(
        packed: *const u8,
        packed_end: *const u8,
        to: *mut u8,
        to_end: *mut u8,
        front_end: *const u8,
        front_len: usize,
    ) -> u32;
    fn calls_to_relative(image: *mut u8, end: *mut u8);
}

/// Unpacks a stream. Returns whether it used all of `packed` and filled all of `to`. `front` is the
/// data before the output; copies may come from there, too.
///
/// No stream can make it read or write outside the three slices, and every stream ends: each step
/// takes a byte from `packed` or writes a byte to `to`.
pub fn unpack(front: &[u8], packed: &[u8], to: &mut [u8]) -> bool {
    let (packed, to) = (packed.as_ptr_range(), to.as_mut_ptr_range());
    // SAFETY: the three slices are valid. The code reads `packed` between its ends, and writes and
    // reads `to` between its own: `literals`, `another` and `refill` compare with the end of
    // `packed`, `copy` with the end of `to`, and `match` with its start. For a copy from before
    // that start, the code compares the distance with the length of `front`, and the copy's length
    // with the bytes left there.
    unsafe {
        zx0_unpack(packed.start, packed.end, to.start, to.end, front.as_ptr_range().end, front.len()) == 0
    }
}

/// Restores the calls of the image to the encoding of the core. Before the image was packed, the
/// target of each `BL` was made absolute, so that two calls of one function are the same bytes
/// (`xtask/src/pack.rs`).
pub fn restore_calls(image: &mut [u8]) {
    let image = image.as_mut_ptr_range();
    // SAFETY: the slice is valid. The code reads and writes half-words while four bytes are left;
    // the image is in RAM, aligned.
    unsafe { calls_to_relative(image.start, image.end) };
}

// r0 next byte of the stream, r1 its end; r2 next byte of the output, r3 its end, r4 its start; r5
// offset of the last copy; r6 the unused bits of a byte of bits, from bit 31 down, followed by a 1;
// r7 the number; r8 the source of a copy; r9 the end of the data before the output, r10 their
// length; r12 is free.
global_asm!(
    ".section .text.zx0_unpack, \"ax\"",
    ".syntax unified",
    ".global zx0_unpack",
    ".type zx0_unpack,%function",
    ".thumb_func",
    "zx0_unpack:",
    "push {{r4-r10, lr}}",
    "ldrd r9, r10, [sp, #32]",
    "mov r4, r2",
    "movs r5, #2",
    "mov r6, #0x80000000",
    // Literals: the number of bytes to copy from the stream.
    ".Lzx0_literals:",
    "movs r7, #1",
    "bl .Lzx0_number",
    "subs r12, r1, r0",
    "cmp r7, r12",
    "bhi .Lzx0_damaged",
    "mov r8, r0",
    "add r0, r7",
    "bl .Lzx0_copy",
    "bcs .Lzx0_another",
    // A copy from the last offset.
    "movs r7, #1",
    "bl .Lzx0_number",
    // A copy from the bytes that were already written, or from the data before the output. (An
    // offset of 0 reads the byte that it overwrites.)
    ".Lzx0_match:",
    "subs r8, r2, r5",
    "subs r12, r2, r4",
    "subs r12, r5, r12",
    "bls .Lzx0_from_output",
    // The copy starts r12 bytes before the output.
    "cmp r12, r10",
    "bhi .Lzx0_damaged",
    "cmp r7, r12",
    "bhi .Lzx0_damaged",
    "sub r8, r9, r12",
    ".Lzx0_from_output:",
    "bl .Lzx0_copy",
    "bcc .Lzx0_literals",
    // A copy from a new offset: the upper part is a number with inverted bits; 256 in its place is
    // the end of the stream. The lower part is a byte. Offsets count half-words.
    ".Lzx0_another:",
    "mvn r7, #1",
    "bl .Lzx0_number",
    "mvns r7, r7",
    "cmp r7, #256",
    "beq .Lzx0_end",
    "cmp r0, r1",
    "bhs .Lzx0_damaged",
    "ldrb r12, [r0], #1",
    "rsb r5, r12, r7, lsl #8",
    "lsls r5, r5, #1",
    "movs r7, #1",
    "bl .Lzx0_number",
    "adds r7, #1",
    "b .Lzx0_match",
    // The stream is damaged: unpacking stops.
    ".Lzx0_damaged:",
    "movs r0, #1",
    "pop {{r4-r10, pc}}",
    // The end of the stream: success if both stream and output end here.
    ".Lzx0_end:",
    "subs r0, r1",
    "subs r2, r3",
    "orrs r0, r2",
    "pop {{r4-r10, pc}}",
    // Shifts a number into r7. A number that is too long loses its upper bits; the code that uses
    // it checks its range.
    ".Lzx0_number:",
    "mov r12, lr",
    ".Lzx0_digit:",
    "adds r6, r6",
    "it eq",
    "bleq .Lzx0_refill",
    "bcs .Lzx0_whole",
    "adds r6, r6",
    "it eq",
    "bleq .Lzx0_refill",
    "adcs r7, r7",
    "b .Lzx0_digit",
    ".Lzx0_whole:",
    "bx r12",
    // Copies r7 bytes (at least 1), and takes the flag after them into the carry.
    ".Lzx0_copy:",
    "subs r7, #1",
    "subs r12, r3, r2",
    "cmp r7, r12",
    "bhs .Lzx0_damaged",
    ".Lzx0_byte:",
    "ldrb r12, [r8], #1",
    "strb r12, [r2], #1",
    "subs r7, #1",
    "bpl .Lzx0_byte",
    "adds r6, r6",
    "bne .Lzx0_taken",
    // Takes a bit from the next byte of bits into the carry.
    ".Lzx0_refill:",
    "cmp r0, r1",
    "bhs .Lzx0_damaged",
    "ldrb r6, [r0], #1",
    "lsls r6, r6, #24",
    "orr r6, r6, #0x800000",
    "adds r6, r6",
    ".Lzx0_taken:",
    "bx lr",
    ".size zx0_unpack, . - zx0_unpack",
);

// r0 next half-word of the image, r1 its end; r2 the first half-word of a call, r12 the second one,
// then the target in half-words; r3 is free. (BL in encoding T1 with the range of ARMv6-M: a RAM
// image needs no farther calls.)
global_asm!(
    ".section .text.calls_to_relative, \"ax\"",
    ".syntax unified",
    ".global calls_to_relative",
    ".type calls_to_relative,%function",
    ".thumb_func",
    "calls_to_relative:",
    "subs r2, r1, r0",
    "cmp r2, #4",
    "blo .Lcalls_end",
    "ldrh r2, [r0], #2",
    "lsrs r3, r2, #11",
    "cmp r3, #0b11110",
    "bne calls_to_relative",
    "ldrh r12, [r0]",
    "lsr r3, r12, #11",
    "cmp r3, #0b11111",
    "bne calls_to_relative",
    "bfi r12, r2, #11, #11",
    "sub r12, r12, r0, lsr #1",
    "ubfx r2, r12, #11, #11",
    "orr r2, r2, #0xF000",
    "strh r2, [r0, #-2]",
    "orr r12, r12, #0xF800",
    "strh r12, [r0], #2",
    "b calls_to_relative",
    ".Lcalls_end:",
    "bx lr",
    ".size calls_to_relative, . - calls_to_relative",
);
