//! What a program tells by `defmt`: frames whose words stand in its ELF file, as a debug probe's
//! viewer decodes them.

use defmt_decoder::{DecodeError, StreamDecoder, Table};

/// Ends a frame (rzCOBS).
const END: u8 = 0;
/// No frame is longer than the ring that it comes through.
const LONGEST_FRAME: usize = 64 * 1024;

/// The words of one program, and what was read of a frame that is not complete.
pub struct Decoder {
    table: Table,
    frame: Vec<u8>,
}

impl Decoder {
    /// For the program of this ELF file; `None` where it has no words for frames.
    ///
    /// # Errors
    /// What is wrong with its words, or that they are of a version of `defmt` that is not known.
    pub fn of_elf(elf: &[u8]) -> Result<Option<Self>, String> {
        let table =
            Table::parse(elf).map_err(|error| format!("the words of defmt in the ELF file: {error:#}"))?;
        Ok(table.map(|table| Self { table, frame: Vec::new() }))
    }

    /// The messages that are complete with these bytes. A frame that means nothing is told as one.
    pub fn messages(&mut self, bytes: &[u8]) -> Vec<String> {
        let mut messages = Vec::new();
        for &byte in bytes {
            if byte != END {
                if self.frame.len() < LONGEST_FRAME {
                    self.frame.push(byte);
                }
                continue;
            }
            let mut frame = std::mem::take(&mut self.frame);
            if frame.is_empty() {
                continue;
            }
            frame.push(END);
            let mut decoder = self.table.new_stream_decoder();
            decoder.received(&frame);
            messages.push(message(&mut *decoder));
        }
        messages
    }
}

fn message(decoder: &mut dyn StreamDecoder) -> String {
    match decoder.decode() {
        Ok(frame) => frame.display_message().to_string(),
        Err(DecodeError::UnexpectedEof | DecodeError::Malformed) => {
            "a frame of defmt that this program's ELF file does not explain".into()
        }
    }
}
