//! What an instruction loads or stores: which one of a block makes a given access, and which one traps by
//! CCR.DIV_0_TRP or CCR.UNALIGN_TRP before it runs (DDI 0403E B3.2.8).
//!
//! Unicorn passes the address to a peripheral's callback, but not the instruction. The registers are up to date
//! then, so the instruction is the one whose base and offset give that address.
//!
//! Encodings: DDI 0403E A5.2 to A5.3; which accesses have to be aligned: A3.2.1.

use crate::cortex::scs::{cfsr, Traps};
use crate::report::Access;

/// An instruction; `second` is 0 for one of 16 bits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Instruction {
    pub address: u32,
    pub first: u16,
    pub second: u16,
}

/// What an instruction does, as far as it can trap or access a peripheral.
enum Operation {
    /// The divisor is this register.
    Division(u32),
    Transfer(Transfer),
}

/// A load or store.
struct Transfer {
    is_load: bool,
    /// The register with the base.
    base: u32,
    offset: Offset,
    /// Bytes from there that it may touch; 0 for the FPU's, which are not looked for.
    len: u32,
    /// What the address has to be aligned to; 1 for nothing.
    alignment: u32,
}

enum Offset {
    Up(u32),
    Down(u32),
    Register { number: u32, shift: u32 },
}

impl Transfer {
    /// The lowest address, with these registers.
    fn address(&self, register: impl Fn(u32) -> Option<u32>) -> Option<u32> {
        let base = register(self.base)?;
        Some(match self.offset {
            Offset::Up(offset) => base.wrapping_add(offset),
            Offset::Down(offset) => base.wrapping_sub(offset),
            Offset::Register { number, shift } => base.wrapping_add(register(number)? << shift),
        })
    }
}

/// The address, relative to the block, of the first instruction in `code` that makes this access,
/// the registers being `registers` (r0 to r14; the PC is no base of an access to a peripheral).
pub fn find(code: &[u8], registers: &[u32; 15], access: Access, address: u32) -> Option<u32> {
    let mut at = 0;
    while let Some(instruction) = Instruction::take(at, code.get(at as usize..)?) {
        if let Some(Operation::Transfer(transfer)) = instruction.operation() {
            let first = transfer.address(|number| registers.get(number as usize).copied());
            let touches = |first: u32| address.wrapping_sub(first) < transfer.len;
            if transfer.is_load == (access == Access::Read) && first.is_some_and(touches) {
                return Some(at);
            }
        }
        at += instruction.len();
    }
    None
}

impl Instruction {
    /// Takes the first instruction of `code`, which lies at `address`.
    pub fn take(address: u32, code: &[u8]) -> Option<Self> {
        let half = |at: usize| Some(u16::from_le_bytes([*code.get(at)?, *code.get(at + 1)?]));
        let first = half(0)?;
        // A5.1: the upper five bits 11101, 11110, 11111 start a 32-bit instruction.
        let second = if first >> 11 >= 0b11101 { half(2)? } else { 0 };
        Some(Self { address, first, second })
    }

    /// Bytes.
    pub fn len(self) -> u32 {
        if self.first >> 11 >= 0b11101 {
            4
        } else {
            2
        }
    }

    /// The IT state after this instruction if it is an IT (A7.7.38).
    pub fn it_state(self) -> Option<u8> {
        (self.first & 0xFF00 == 0xBF00 && self.first & 0xF != 0).then_some((self.first & 0xFF) as u8)
    }

    /// Whether it may trap at all.
    pub fn may_trap(self, traps: Traps) -> bool {
        match self.operation() {
            Some(Operation::Division(_)) => traps.division,
            Some(Operation::Transfer(transfer)) => traps.unaligned && transfer.alignment > 1,
            None => false,
        }
    }

    /// The CFSR bit of the UsageFault that it raises with these registers (r0 to r14).
    pub fn traps(self, traps: Traps, register: impl Fn(u32) -> u32) -> Option<u32> {
        match self.operation()? {
            Operation::Division(divisor) => {
                (traps.division && register(divisor) == 0).then_some(cfsr::DIVBYZERO)
            }
            Operation::Transfer(transfer) => {
                // As a base, the PC is that of the next instruction but one, aligned to 4; TBH does
                // not align it, and it is even.
                let pc = (self.address + 4) & !3;
                let address = transfer.address(|n| Some(if n == 15 { pc } else { register(n) }))?;
                (traps.unaligned && address % transfer.alignment != 0).then_some(cfsr::UNALIGNED)
            }
        }
    }

    fn operation(self) -> Option<Operation> {
        if self.len() == 2 {
            narrow(self.first).map(Operation::Transfer)
        } else if self.first & 0xFFD0 == 0xFB90 && self.second & 0xF0F0 == 0xF0F0 {
            // SDIV, UDIV (A5.3.17).
            Some(Operation::Division(field(self.second, 0, 4)))
        } else {
            wide(self.first, self.second).map(Operation::Transfer)
        }
    }
}

/// Whether a condition (A7.3) holds with the flags of this xPSR.
pub fn holds(condition: u8, xpsr: u32) -> bool {
    let flag = |bit: u32| xpsr >> bit & 1 != 0;
    let (n, z, c, v) = (flag(31), flag(30), flag(29), flag(28));
    let met = match condition >> 1 {
        0b000 => z,
        0b001 => c,
        0b010 => n,
        0b011 => v,
        0b100 => c && !z,
        0b101 => n == v,
        0b110 => n == v && !z,
        _ => return true,
    };
    met != (condition & 1 != 0)
}

/// The IT state after one more instruction (A7.3.2, ITAdvance).
pub fn advance(it: u8) -> u8 {
    if it & 7 == 0 {
        0
    } else {
        it & 0xE0 | it << 1 & 0x1F
    }
}

/// The IT state that an xPSR holds (B1.4.2).
pub fn it_state(xpsr: u32) -> u8 {
    ((xpsr >> 8 & 0xFC) | (xpsr >> 25 & 3)) as u8
}

fn field(word: u16, shift: u32, bits: u32) -> u32 {
    u32::from(word) >> shift & ((1 << bits) - 1)
}

fn narrow(code: u16) -> Option<Transfer> {
    let (base, offset) = (field(code, 3, 3), field(code, 6, 5));
    let is_load = field(code, 11, 1) == 1;
    let transfer = |offset, size| Some(Transfer { is_load, base, offset, len: size, alignment: size });
    match code >> 11 {
        // STR, STRH, STRB, LDRSB, LDR, LDRH, LDRB, LDRSH with a register as the offset.
        0b01010 | 0b01011 => {
            let kind = field(code, 9, 3);
            let alignment = match kind {
                0b000 | 0b100 => 4,
                0b001 | 0b101 | 0b111 => 2,
                _ => 1,
            };
            let offset = Offset::Register { number: field(code, 6, 3), shift: 0 };
            Some(Transfer { is_load: kind >= 3, base, offset, len: 4, alignment })
        }
        0b01100 | 0b01101 => transfer(Offset::Up(4 * offset), 4),
        0b01110 | 0b01111 => transfer(Offset::Up(offset), 1),
        0b10000 | 0b10001 => transfer(Offset::Up(2 * offset), 2),
        // STM, LDM.
        0b11000 | 0b11001 => {
            let len = 4 * (code & 0xFF).count_ones();
            Some(Transfer { is_load, base: field(code, 8, 3), offset: Offset::Up(0), len, alignment: 4 })
        }
        // The rest goes by SP or PC, which are aligned and no bases of a peripheral.
        _ => None,
    }
}

fn wide(first: u16, second: u16) -> Option<Transfer> {
    let base = field(first, 0, 4);
    let (is_load, up) = (field(first, 4, 1) == 1, field(first, 7, 1) == 1);
    let transfer = |offset, len, alignment| Some(Transfer { is_load, base, offset, len, alignment });
    let by = |up: bool, offset: u32| if up { Offset::Up(offset) } else { Offset::Down(offset) };
    // Loads and stores of one register (A5.3.7 to A5.3.10).
    if first & 0xFE00 == 0xF800 {
        let size = 1 << field(first, 5, 2);
        let is_hint = is_load && size == 2 && second >> 12 == 15;
        let offset = if base == 15 || up {
            // The literal forms and the ones with 12 bits.
            by(up, field(second, 0, 12))
        } else if field(second, 11, 1) == 0 {
            Offset::Register { number: field(second, 0, 4), shift: field(second, 4, 2) }
        } else if field(second, 10, 1) == 0 {
            Offset::Up(0)
        } else {
            by(field(second, 9, 1) == 1, field(second, 0, 8))
        };
        return transfer(offset, size.min(4), if is_hint || size == 8 { 1 } else { size });
    }
    let indexed = if field(first, 8, 1) == 1 { by(up, 4 * field(second, 0, 8)) } else { Offset::Up(0) };
    // LDRD, STRD; with neither index nor write-back TBH, and the exclusive ones, which Unicorn
    // checks (A5.3.6).
    if first & 0xFE40 == 0xE840 {
        return match (first & 0x0120, first & 0xFFF0, second & 0xFFF0) {
            (0, 0xE8D0, 0xF010) => transfer(Offset::Register { number: field(second, 0, 4), shift: 1 }, 2, 2),
            (0, _, _) => transfer(indexed, 8, 1),
            _ => transfer(indexed, 8, 4),
        };
    }
    // LDM, STM (A5.3.5).
    if first & 0xFE40 == 0xE800 {
        let len = 4 * second.count_ones();
        return transfer(if field(first, 8, 1) == 1 { Offset::Down(len) } else { Offset::Up(0) }, len, 4);
    }
    // VLDR, VSTR, VLDM, VSTM (A6.5); the rest of this space moves two registers (A6.7).
    if first & 0xFE00 == 0xEC00 && second & 0x0E00 == 0x0A00 && first & 0x01A0 != 0 {
        return transfer(Offset::Up(0), 0, 4);
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOTH: Traps = Traps { division: true, unaligned: true };

    fn traps(halves: &[u16], registers: &[u32; 15]) -> Option<u32> {
        let code: Vec<u8> = halves.iter().flat_map(|half| half.to_le_bytes()).collect();
        let instruction = Instruction::take(0x2000_0002, &code).unwrap();
        assert_eq!(instruction.len() as usize, code.len());
        let verdict = instruction.traps(BOTH, |n| registers[n as usize]);
        assert!(verdict.is_none() || instruction.may_trap(BOTH), "{halves:04X?}");
        assert_eq!(instruction.traps(Traps::default(), |n| registers[n as usize]), None);
        verdict
    }

    /// Machine code from LLVM's assembler. r1 is aligned to 4, r2 is 2, r3 is 1.
    #[test]
    fn words_and_halfwords_have_to_be_aligned_and_bytes_not() {
        let mut registers = [0; 15];
        (registers[1], registers[2], registers[3]) = (0x2000_0400, 2, 1);
        for (code, size) in [
            (&[0x5888][..], 4),     // ldr r0, [r1, r2]
            (&[0x58C8], 4),         // ldr r0, [r1, r3]
            (&[0x5A88], 1),         // ldrh r0, [r1, r2]
            (&[0x5AC8], 2),         // ldrh r0, [r1, r3]
            (&[0x5EC8], 2),         // ldrsh r0, [r1, r3]
            (&[0x56C8], 1),         // ldrsb r0, [r1, r3]
            (&[0x54C8], 1),         // strb r0, [r1, r3]
            (&[0x6850], 4),         // ldr r0, [r2, #4]
            (&[0x6848], 1),         // ldr r0, [r1, #4]
            (&[0x8058], 2),         // strh r0, [r3, #2]
            (&[0x8850], 1),         // ldrh r0, [r2, #2]
            (&[0x7858], 1),         // ldrb r0, [r3, #1]
            (&[0xC211], 4),         // stmia r2!, {r0, r4}
            (&[0xC911], 1),         // ldmia r1!, {r0, r4}
            (&[0xF8D1, 0x0002], 4), // ldr.w r0, [r1, #2]
            (&[0xF8D1, 0x0004], 1), // ldr.w r0, [r1, #4]
            (&[0xF851, 0x0D02], 4), // ldr.w r0, [r1, #-2]!
            (&[0xF851, 0x0B02], 1), // ldr.w r0, [r1], #2
            (&[0xF851, 0x0C04], 1), // ldr.w r0, [r1, #-4]
            (&[0xF851, 0x0013], 4), // ldr.w r0, [r1, r3, lsl #1]
            (&[0xF851, 0x0012], 1), // ldr.w r0, [r1, r2, lsl #1]
            (&[0xF8B1, 0x0001], 2), // ldrh.w r0, [r1, #1]
            (&[0xF9B1, 0x0001], 2), // ldrsh.w r0, [r1, #1]
            (&[0xF851, 0x0E01], 4), // ldrt r0, [r1, #1]
            (&[0xF89F, 0x0001], 1), // ldrb.w r0, [pc, #1]
            (&[0xF8BF, 0x0001], 2), // ldrh.w r0, [pc, #1]
            (&[0xF8DF, 0x0008], 1), // ldr.w r0, [pc, #8]
            (&[0xF893, 0xF000], 1), // pld [r3]
            (&[0xE9D2, 0x0402], 4), // ldrd r0, r4, [r2, #8]
            (&[0xE8E1, 0x0401], 1), // strd r0, r4, [r1], #4
            (&[0xE852, 0x0F00], 1), // ldrex r0, [r2]: Unicorn's
            (&[0xE8D1, 0xF013], 1), // tbh [r1, r3, lsl #1]
            (&[0xE8D3, 0xF012], 2), // tbh [r3, r2, lsl #1]
            (&[0xE8D3, 0xF002], 1), // tbb [r3, r2]
            (&[0xE912, 0x0031], 4), // ldmdb r2, {r0, r4, r5}
            (&[0xED92, 0x0A01], 4), // vldr s0, [r2, #4]
            (&[0xED81, 0x0A01], 1), // vstr s0, [r1, #4]
            (&[0xECA2, 0x0A02], 4), // vstmia r2!, {s0, s1}
            (&[0xEC54, 0x2B10], 1), // vmov r2, r4, d0
            (&[0xEE02, 0x0A10], 1), // vmov s4, r0
        ] {
            let expected = (size > 1).then_some(cfsr::UNALIGNED);
            assert_eq!(traps(code, &registers), expected, "{code:04X?}");
        }
    }

    #[test]
    fn a_division_traps_by_its_divisor() {
        let mut registers = [7; 15];
        registers[1] = 0;
        assert_eq!(traps(&[0xFBB0, 0xF2F1], &registers), Some(cfsr::DIVBYZERO)); // udiv r2, r0, r1
        assert_eq!(traps(&[0xFB90, 0xF2F1], &registers), Some(cfsr::DIVBYZERO)); // sdiv r2, r0, r1
        assert_eq!(traps(&[0xFBB1, 0xF2F0], &registers), None); // udiv r2, r1, r0
        assert_eq!(traps(&[0xFBA0, 0x2301], &registers), None); // umull r2, r3, r0, r1
    }

    /// A7.3: the conditions; A7.3.2: ITAdvance.
    #[test]
    fn conditions_and_the_state_of_an_it_block() {
        const Z: u32 = 1 << 30;
        const N: u32 = 1 << 31;
        assert!(holds(0, Z) && !holds(1, Z) && !holds(0, 0) && holds(1, 0));
        assert!(holds(0xB, N) && !holds(0xA, N) && holds(0xE, 0));
        // ITTE EQ: EQ, EQ, NE.
        let it = Instruction { address: 0, first: 0xBF06, second: 0 }.it_state().unwrap();
        let states = [it, advance(it), advance(advance(it))];
        assert_eq!(states.map(|state| state >> 4), [0, 0, 1]);
        assert_eq!(advance(states[2]), 0);
        assert_eq!(it_state(0x0600_FC00), 0xFF);
        assert_eq!(Instruction { address: 0, first: 0xBF30, second: 0 }.it_state(), None, "wfi");
    }

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
