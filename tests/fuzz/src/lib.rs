//! Common code of the fuzz targets. `cargo xtask fuzz` runs them; the first lines of each target
//! say what must hold.

use std::path::{Path, PathBuf};

#[cfg(fuzzing)]
pub use libfuzzer_sys;

/// The body of a target: the program of libFuzzer under `cargo fuzz`. Under plain cargo it is a
/// program that runs each file once that is named, and each file of a folder that is named.
#[macro_export]
macro_rules! target {
    (|$bytes:ident: &[u8]| $body:block) => {
        #[cfg(fuzzing)]
        $crate::libfuzzer_sys::fuzz_target!(|$bytes: &[u8]| $body);

        #[cfg(not(fuzzing))]
        fn main() -> std::process::ExitCode {
            $crate::replay(|$bytes: &[u8]| $body)
        }
    };
}

/// Runs a target with each file that the arguments name, in the order of their names, and prints
/// how many there were. The name of a file is on standard error before a panic ends the run.
pub fn replay(target: impl Fn(&[u8])) -> std::process::ExitCode {
    let mut count = 0;
    for argument in std::env::args_os().skip(1) {
        for file in files(Path::new(&argument)) {
            let Ok(bytes) = std::fs::read(&file) else {
                eprintln!("{} cannot be read.", file.display());
                return std::process::ExitCode::FAILURE;
            };
            let reported = Told(&file);
            target(&bytes);
            std::mem::forget(reported);
            count += 1;
        }
    }
    println!("{count}");
    std::process::ExitCode::SUCCESS
}

/// The file itself, or those in the folder.
fn files(path: &Path) -> Vec<PathBuf> {
    let Ok(folder) = std::fs::read_dir(path) else { return vec![path.to_owned()] };
    let mut files: Vec<_> = folder.flatten().map(|entry| entry.path()).collect();
    files.sort();
    files
}

/// Prints its file when a panic drops it.
struct Told<'p>(&'p Path);

impl Drop for Told<'_> {
    fn drop(&mut self) {
        eprintln!("with the input {}", self.0.display());
    }
}

use canopen::node::Node;
use canopen::sdo::client::{Step, Transfer};
use canopen::sdo::SdoError;
use canopen::{CobId, Frame, Instant};
use kit::bus::Device;

/// The fuzzer's bytes, consumed from the front.
pub struct Input<'a>(&'a [u8]);

impl<'a> Input<'a> {
    /// All bytes.
    #[must_use]
    pub fn new(bytes: &'a [u8]) -> Self {
        Self(bytes)
    }

    /// The next byte; `None` at the end.
    pub fn byte(&mut self) -> Option<u8> {
        let (first, rest) = self.0.split_first()?;
        self.0 = rest;
        Some(*first)
    }

    /// The next `N` bytes; `None` if there are fewer.
    pub fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (first, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(*first)
    }

    /// At most `most` of the next bytes.
    pub fn take(&mut self, most: usize) -> &'a [u8] {
        let (first, rest) = self.0.split_at(most.min(self.0.len()));
        self.0 = rest;
        first
    }

    /// Any frame with 11 bits and up to eight bytes; `None` at the end.
    pub fn frame(&mut self) -> Option<Frame> {
        let [low, high, len] = self.array()?;
        let id = CobId::new(u16::from_le_bytes([low, high]) & 0x7FF).expect("11 bits");
        Some(Frame::of(id, self.take(usize::from(len) % 9)))
    }

    /// The remaining bytes.
    #[must_use]
    pub fn rest(self) -> &'a [u8] {
        self.0
    }
}

/// True for one of eight inputs, always the same: for what takes longer than the rest of a target.
#[must_use]
pub fn is_eighth(bytes: &[u8]) -> bool {
    bytes.iter().fold(0_u8, |sum, byte| sum.wrapping_add(*byte)).is_multiple_of(8)
}

/// More frames than any correct sender sends in a row: beyond this number, it never ends.
pub const ENDLESS: usize = 1000;

/// Fetches all frames that a node has to send.
pub fn drain(node: &mut Node, now: Instant, device: &mut Device) {
    let sent = std::iter::from_fn(|| node.poll(now, device)).take(ENDLESS).count();
    assert!(sent < ENDLESS, "the node never stops sending");
}

/// Runs a transfer to its end over a wire without losses.
pub fn run(
    transfer: &mut impl Transfer,
    node: &mut Node,
    device: &mut Device,
    now: Instant,
) -> Result<(), SdoError> {
    for _ in 0..100 * ENDLESS {
        match transfer.poll(now) {
            Step::Send(frame) => {
                node.handle(&frame, now, device);
                while let Some(answer) = node.poll(now, device) {
                    transfer.handle(&answer, now);
                }
            }
            Step::Wait(_) => panic!("the transfer stands still"),
            Step::Done(result) => return result,
        }
    }
    panic!("the transfer never ends");
}
