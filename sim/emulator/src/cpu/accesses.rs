//! Which instruction of a block makes a given access.
//!
//! Unicorn passes the address to a peripheral's callback, but not the instruction. The registers
//! are up to date then, so the instruction is the one whose base and offset give that address
//! (encodings: DDI 0403E A5.2.4 and A5.3.5 to A5.3.10).

use crate::report::Access;

/// A load or store as far as its address goes.
struct Form {
    access: Access,
    /// Lowest address.
    first: u32,
    /// Bytes from there that it may touch.
    len: u32,
}

/// The address, relative to the block, of the first instruction in `code` that makes this access,
/// the registers being `registers` (r0 to r14).
pub fn find(code: &[u8], registers: &[u32; 15], access: Access, address: u32) -> Option<u32> {
    let halves: Vec<u16> = code.chunks_exact(2).map(|half| u16::from_le_bytes([half[0], half[1]])).collect();
    let mut at = 0;
    while at < halves.len() {
        let first = halves[at];
        let wide = first >> 11 >= 0b11101;
        let form = if wide {
            halves.get(at + 1).and_then(|&second| wide_form(first, second, registers))
        } else {
            narrow_form(first, registers)
        };
        if form.is_some_and(|f| f.access == access && address.wrapping_sub(f.first) < f.len) {
            return u32::try_from(2 * at).ok();
        }
        at += if wide { 2 } else { 1 };
    }
    None
}

fn direction(load: bool) -> Access {
    if load {
        Access::Read
    } else {
        Access::Write
    }
}

fn field(word: u16, shift: u32, bits: u32) -> u32 {
    u32::from(word) >> shift & ((1 << bits) - 1)
}

/// The register of a field; the PC (15) is no base of an access to a peripheral.
fn register(registers: &[u32; 15], number: u32) -> Option<u32> {
    registers.get(number as usize).copied()
}

fn narrow_form(code: u16, registers: &[u32; 15]) -> Option<Form> {
    let base = register(registers, field(code, 3, 3))?;
    let offset = field(code, 6, 5);
    let (load, first, len) = match code >> 11 {
        0b01010 | 0b01011 => {
            let load = field(code, 9, 3) >= 3;
            (load, base.wrapping_add(register(registers, field(code, 6, 3))?), 4)
        }
        0b01100 => (false, base.wrapping_add(4 * offset), 4),
        0b01101 => (true, base.wrapping_add(4 * offset), 4),
        0b01110 => (false, base.wrapping_add(offset), 1),
        0b01111 => (true, base.wrapping_add(offset), 1),
        0b10000 => (false, base.wrapping_add(2 * offset), 2),
        0b10001 => (true, base.wrapping_add(2 * offset), 2),
        kind @ (0b11000 | 0b11001) => {
            let base = register(registers, field(code, 8, 3))?;
            (kind & 1 != 0, base, 4 * (code & 0xFF).count_ones())
        }
        _ => return None,
    };
    Some(Form { access: direction(load), first, len })
}

fn wide_form(first: u16, second: u16, registers: &[u32; 15]) -> Option<Form> {
    let base = register(registers, field(first, 0, 4))?;
    let load = field(first, 4, 1) == 1;
    let indexed = |before: bool, up: bool, offset: u32| match (before, up) {
        (false, _) => base,
        (true, true) => base.wrapping_add(offset),
        (true, false) => base.wrapping_sub(offset),
    };
    let (first, len) = if first & 0xFE00 == 0xF800 {
        let len = 1 << field(first, 5, 2).min(2);
        let address = if field(first, 7, 1) == 1 {
            base.wrapping_add(field(second, 0, 12))
        } else if field(second, 11, 1) == 1 {
            indexed(field(second, 10, 1) == 1, field(second, 9, 1) == 1, field(second, 0, 8))
        } else {
            let index = register(registers, field(second, 0, 4))?;
            base.wrapping_add(index << field(second, 4, 2))
        };
        (address, len)
    } else if first & 0xFE40 == 0xE840 {
        (indexed(field(first, 8, 1) == 1, field(first, 7, 1) == 1, 4 * field(second, 0, 8)), 8)
    } else if first & 0xFE40 == 0xE800 {
        let len = 4 * second.count_ones();
        let down = field(first, 8, 1) == 1;
        (if down { base.wrapping_sub(len) } else { base }, len)
    } else {
        return None;
    };
    Some(Form { access: direction(load), first, len })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Machine code from GNU as.
    #[test]
    fn finds_loads_and_stores_of_every_shape() {
        let mut registers = [0; 15];
        registers[1] = 0x4000_0000;
        registers[2] = 0x10;
        for (code, access, address) in [
            (&[0x6848][..], Access::Read, 0x4000_0004),      // ldr r0, [r1, #4]
            (&[0x6048], Access::Write, 0x4000_0004),         // str r0, [r1, #4]
            (&[0x7848], Access::Read, 0x4000_0001),          // ldrb r0, [r1, #1]
            (&[0x8088], Access::Write, 0x4000_0004),         // strh r0, [r1, #4]
            (&[0x5888], Access::Read, 0x4000_0010),          // ldr r0, [r1, r2]
            (&[0x5088], Access::Write, 0x4000_0010),         // str r0, [r1, r2]
            (&[0xC919], Access::Read, 0x4000_0008),          // ldmia r1, {r0, r3, r4}
            (&[0xF8D1, 0x0234], Access::Read, 0x4000_0234),  // ldr.w r0, [r1, #564]
            (&[0xF8C1, 0x0234], Access::Write, 0x4000_0234), // str.w r0, [r1, #564]
            (&[0xF841, 0x0D04], Access::Write, 0x3FFF_FFFC), // str.w r0, [r1, #-4]!
            (&[0xF851, 0x0B04], Access::Read, 0x4000_0000),  // ldr.w r0, [r1], #4
            (&[0xF851, 0x0022], Access::Read, 0x4000_0040),  // ldr.w r0, [r1, r2, lsl #2]
            (&[0xE9D1, 0x0302], Access::Read, 0x4000_000C),  // ldrd r0, r3, [r1, #8]
            (&[0xE9C1, 0x0302], Access::Write, 0x4000_0008), // strd r0, r3, [r1, #8]
        ] {
            // Something harmless before it: movs r0, #1.
            let code: Vec<u8> =
                [0x2001].iter().chain(code).flat_map(|half: &u16| half.to_le_bytes()).collect();
            assert_eq!(find(&code, &registers, access, address), Some(2), "{code:02X?}");
            assert_eq!(find(&code, &registers, access, address + 0x100), None);
            let other = if access == Access::Read { Access::Write } else { Access::Read };
            assert_eq!(find(&code, &registers, other, address), None);
        }
    }

    #[test]
    fn cut_off_code_is_no_trouble() {
        assert_eq!(find(&[0xD1, 0xF8], &[0; 15], Access::Read, 0), None);
        assert_eq!(find(&[0xD1], &[0; 15], Access::Read, 0), None);
    }
}
