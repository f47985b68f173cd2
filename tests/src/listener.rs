//! Who reads what a bootloader tells by its log.

use emulator::defmt::Decoder;
use emulator::machine::Machine;
use emulator::periph::usart::Character;
use emulator::rtt::Reader;

use crate::bench::Bench;
use crate::firmware;

/// Who reads it.
pub enum Listener {
    /// A debug probe.
    Probe(Reader),
    /// A terminal: what of a line it has.
    Terminal(Vec<u8>),
}

impl Listener {
    /// A debug probe that reads text.
    #[must_use]
    pub fn probe() -> Self {
        Self::Probe(Reader::default())
    }

    /// A debug probe that has an image's ELF file, and reads frames of `defmt` by it.
    #[must_use]
    pub fn probe_of(image: &str) -> Self {
        Self::Probe(Reader::with(Some(decoder(image))))
    }

    /// A terminal at the board's UART.
    #[must_use]
    pub const fn terminal() -> Self {
        Self::Terminal(Vec::new())
    }

    /// The whole lines since the last time.
    ///
    /// # Panics
    /// If what comes out of the UART is no text.
    pub fn told(&mut self, bench: &mut Bench) -> Vec<String> {
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

/// What has come out of the board's UARTs; a terminal at 115 200 bit/s reads what is 2 % off at
/// most.
///
/// # Panics
/// If it is further off.
pub fn heard(machine: &mut Machine) -> Vec<Character> {
    let usarts = machine.usarts_mut().iter_mut();
    let heard: Vec<_> = usarts.flat_map(|usart| usart.take_sent()).collect();
    assert!(heard.iter().all(|character| character.bit_rate.abs_diff(115_200) < 2_304), "{heard:?}");
    heard
}

/// What explains the frames of an image.
///
/// # Panics
/// If it has none.
#[must_use]
pub fn decoder(image: &str) -> Decoder {
    Decoder::of_elf(&firmware::elf(image)).expect("words that are understood").expect("words")
}
