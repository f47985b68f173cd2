//! The messages that a program sends with `defmt`: frames whose texts are in the program's ELF
//! file. They are decoded as the viewer of a debug probe does it.

use defmt_decoder::{DecodeError, StreamDecoder, Table};

/// Ends a frame (rzCOBS).
const END: u8 = 0;
/// No frame is longer than the ring that it comes through.
const LONGEST_FRAME: usize = 64 * 1024;

/// The texts of one program, and the bytes of a frame that is not complete.
pub struct Decoder {
    table: Table,
    frame: Vec<u8>,
}

impl Decoder {
    /// The decoder for the program of this ELF file; `None` if the file has no texts for frames.
    ///
    /// # Errors
    /// The error in the texts, or that they are of an unknown version of `defmt`.
    pub fn of_elf(elf: &[u8]) -> Result<Option<Self>, String> {
        let table =
            Table::parse(elf).map_err(|error| format!("the words of defmt in the ELF file: {error:#}"))?;
        Ok(table.map(|table| Self { table, frame: Vec::new() }))
    }

    /// The messages that are complete with these bytes. A frame that cannot be decoded gives a
    /// message that says so.
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
