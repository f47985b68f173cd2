//! The readers of a bootloader's log.

use emulator::defmt::Decoder;
use emulator::machine::Machine;
use emulator::periph::usart::Character;
use emulator::rtt::Reader;

use crate::bench::Bench;
use crate::firmware;

/// The reader of the log.
pub enum Listener {
    /// A debug probe.
    Probe(Reader),
    /// A terminal: the received part of a line.
    Terminal(Vec<u8>),
}

impl Listener {
    /// A debug probe that reads text.
    pub fn probe() -> Self {
        Self::Probe(Reader::default())
    }

    /// A debug probe that reads frames of `defmt` with the help of an image's ELF file.
    pub fn probe_of(image: &str) -> Self {
        Self::Probe(Reader::with(Some(decoder(image))))
    }

    /// A terminal at the board's UART.
    pub const fn terminal() -> Self {
        Self::Terminal(Vec::new())
    }

    /// The complete lines since the last call.
    ///
    /// # Panics
    /// If the UART's output is not text.
    pub fn lines(&mut self, bench: &mut Bench) -> Vec<String> {
        match self {
            Self::Probe(reader) => reader.lines(bench.machine(), firmware::board().chip.sram),
            Self::Terminal(line) => {
                line.extend(heard(bench.machine()).iter().map(|character| character.byte));
                let text = std::mem::take(line);
                let text = String::from_utf8(text).expect("text");
                let mut lines: Vec<_> = text.split_inclusive("\r\n").map(str::to_owned).collect();
                if let Some(part) = lines.pop_if(|line| !line.ends_with("\r\n")) {
                    *line = part.into_bytes();
                }
                lines.iter().map(|line| line.trim_end().to_owned()).collect()
            }
        }
    }
}

/// The output of the board's UARTs; a terminal at 115 200 bit/s tolerates an error of 2 %.
///
/// # Panics
/// If the error is larger.
pub fn heard(machine: &mut Machine) -> Vec<Character> {
    let usarts = machine.usarts_mut().iter_mut();
    let heard: Vec<_> = usarts.flat_map(|usart| usart.take_sent()).collect();
    assert!(heard.iter().all(|character| character.bit_rate.abs_diff(115_200) < 2_304), "{heard:?}");
    heard
}

/// The decoder for the frames of an image.
///
/// # Panics
/// If the image has none.
pub fn decoder(image: &str) -> Decoder {
    Decoder::of_elf(&firmware::elf(image)).expect("words that are understood").expect("words")
}
