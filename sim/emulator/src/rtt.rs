//! The text that a program writes for a debug probe: SEGGER's RTT (J-Link manual UM08001, chapter
//! 16), read from RAM as a probe does it.

use shared_abi::geometry::Region;

use crate::defmt::Decoder;
use crate::machine::Machine;

/// The first bytes of a control block.
const ID: &[u8; 16] = b"SEGGER RTT\0\0\0\0\0\0";
/// The number of up buffers is after it.
const UP_BUFFERS: u32 = 16;
/// The first buffer's description: name, memory, size, the program's offset, the probe's offset.
const NAME: u32 = 24;
const MEMORY: u32 = 28;
const SIZE: u32 = 32;
const WRITTEN: u32 = 36;
const READ: u32 = 40;
/// No buffer of a chip like this is larger.
const LARGEST: u32 = 64 * 1024;
/// A line is cut here, if the program does not end it.
const LONGEST_LINE: usize = 256;

/// The name of a buffer that holds frames of `defmt` and no text.
const FRAMES: &[u8; 6] = b"defmt\0";

/// Reads the first buffer of a board's control block.
#[derive(Default)]
pub struct Reader {
    /// The address at which the block was found last.
    block: Option<u32>,
    /// The text of a line that is not complete.
    line: Vec<u8>,
    /// The decoder for frames of `defmt`.
    decoder: Option<Decoder>,
}

impl Reader {
    /// A reader that also decodes frames of `defmt` if the program writes them.
    #[must_use]
    pub fn with(decoder: Option<Decoder>) -> Self {
        Self { decoder, ..Self::default() }
    }

    /// The lines that the program has written since the last call. The block is searched in `sram`.
    /// A block whose content is invalid gives no lines.
    pub fn lines(&mut self, machine: &mut Machine, sram: Region) -> Vec<String> {
        let is_there = |block: &u32| read::<16>(machine, *block).as_ref() == Some(ID);
        // A reset may have brought another program.
        self.block = self.block.filter(is_there).or_else(|| find(machine, sram));
        let Some(block) = self.block else { return Vec::new() };
        let news = take(machine, block).unwrap_or_default();
        match &mut self.decoder {
            Some(decoder) if holds_frames(machine, block) => decoder.messages(&news),
            _ => self.text(&news),
        }
    }

    fn text(&mut self, news: &[u8]) -> Vec<String> {
        let mut lines = Vec::new();
        for &byte in news {
            if byte != b'\n' && self.line.len() < LONGEST_LINE {
                self.line.push(byte);
                continue;
            }
            let line = String::from_utf8_lossy(&std::mem::take(&mut self.line)).into_owned();
            lines.push(line.trim_end().chars().map(|c| if c.is_control() { '?' } else { c }).collect());
        }
        lines
    }
}

fn read<const N: usize>(machine: &Machine, address: u32) -> Option<[u8; N]> {
    let mut bytes = [0; N];
    machine.read_memory(address, &mut bytes).ok()?;
    Some(bytes)
}

fn find(machine: &Machine, sram: Region) -> Option<u32> {
    let mut ram = vec![0; sram.size as usize];
    machine.read_memory(sram.base, &mut ram).ok()?;
    let at = ram.chunks_exact(4).position(|word| word == &ID[..4]);
    let mut from = at? * 4;
    while let Some(found) = ram.get(from..from + ID.len()) {
        if found == ID {
            return Some(sram.base + from as u32);
        }
        from += 4;
    }
    None
}

fn holds_frames(machine: &Machine, block: u32) -> bool {
    let name = block.checked_add(NAME).and_then(|at| read::<4>(machine, at)).map(u32::from_le_bytes);
    name.and_then(|name| read(machine, name)).as_ref() == Some(FRAMES)
}

/// Takes the bytes between the two offsets, and advances the probe's offset.
fn take(machine: &mut Machine, block: u32) -> Option<Vec<u8>> {
    let word = |machine: &Machine, offset: u32| {
        read::<4>(machine, block.checked_add(offset)?).map(u32::from_le_bytes)
    };
    let (memory, size) = (word(machine, MEMORY)?, word(machine, SIZE)?);
    let (written, from) = (word(machine, WRITTEN)?, word(machine, READ)?);
    if word(machine, UP_BUFFERS)? == 0 || size > LARGEST || written >= size || from >= size || written == from
    {
        return None;
    }
    let mut ring = vec![0; size as usize];
    machine.read_memory(memory, &mut ring).ok()?;
    let (written_at, from) = (written as usize, from as usize);
    let bytes = if from < written_at {
        ring[from..written_at].to_vec()
    } else {
        [&ring[from..], &ring[..written_at]].concat()
    };
    machine.write_ram(block + READ, &written.to_le_bytes()).ok()?;
    Some(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::machine::Options;
    use shared_abi::geometry::{STM32F407VG, STM32F429ZI, STM32F446RE};

    const BLOCK: u32 = 0x2000_0100;
    const RING: u32 = 0x2000_0200;

    fn machine(fields: [u32; 5], ring: &[u8]) -> Machine {
        let mut machine = Machine::new(&STM32F407VG, Options::default()).unwrap();
        let [memory, size, written, from, up] = fields;
        let mut block = ID.to_vec();
        for word in [up, 0, 0, memory, size, written, from, 0] {
            block.extend(word.to_le_bytes());
        }
        machine.write_ram(RING, ring).unwrap();
        machine.write_ram(BLOCK, &block).unwrap();
        machine
    }

    fn lines(machine: &mut Machine) -> Vec<String> {
        Reader::default().lines(machine, STM32F407VG.sram)
    }

    #[test]
    fn what_lies_round_the_corner_is_read_once() {
        let mut machine = machine([RING, 8, 3, 6, 1], b"y\r\nxxxhe");
        assert_eq!(lines(&mut machine), ["hey"]);
        assert_eq!(read(&machine, BLOCK + READ), Some(3_u32.to_le_bytes()));
        assert!(lines(&mut machine).is_empty());
    }

    /// SRAM in three parts, without a gap (RM0090 section 2.3.1).
    #[test]
    fn every_chip_has_one() {
        for chip in [&STM32F446RE, &STM32F429ZI] {
            let mut machine = Machine::new(chip, Options::default()).unwrap();
            let block = chip.sram.end() - 64;
            let bytes: Vec<u8> = [1, 0, 0, RING, 8, 3, 0, 0].into_iter().flat_map(u32::to_le_bytes).collect();
            machine.write_ram(RING, b"hi\n").unwrap();
            machine.write_ram(block, &[ID, &bytes[..]].concat()).unwrap();
            assert_eq!(Reader::default().lines(&mut machine, chip.sram), ["hi"], "{}", chip.chip);
        }
    }

    #[test]
    fn noise_is_no_text() {
        for fields in [
            [RING, 8, 8, 0, 1],
            [RING, 8, 3, 9, 1],
            [RING, u32::MAX, 3, 0, 1],
            [0x4000_0000, 8, 3, 0, 1],
            [u32::MAX, 8, 3, 0, 1],
            [RING, 0, 0, 0, 1],
            [RING, 8, 3, 0, 0],
        ] {
            assert!(lines(&mut machine(fields, b"ab\ndefgh")).is_empty(), "{fields:x?}");
        }
    }

    #[test]
    fn a_line_goes_on_with_the_next_look_and_has_an_end() {
        let mut machine = machine([RING, 1024, 2, 0, 1], b"on\x07e\n");
        let mut reader = Reader::default();
        assert!(reader.lines(&mut machine, STM32F407VG.sram).is_empty());
        machine.write_ram(BLOCK + WRITTEN, &5_u32.to_le_bytes()).unwrap();
        assert_eq!(reader.lines(&mut machine, STM32F407VG.sram), ["on?e"]);
        machine.write_ram(RING, &[b'a'; 1024]).unwrap();
        machine.write_ram(BLOCK + WRITTEN, &1000_u32.to_le_bytes()).unwrap();
        assert!(reader.lines(&mut machine, STM32F407VG.sram).iter().all(|line| line.len() <= LONGEST_LINE));
    }
}
