//! `coflash more debug`: memory and breakpoints of a device on the bench.

use std::path::PathBuf;
use std::time::Duration;

use canopen::debugger::Stop;
use clap::{Args, Subcommand};
use coflash_core::device::debugger::{Debugger, NoBreakpoint, Registers, Stopped, BREAKPOINTS, NAMES};
use coflash_core::device::value::hex_digits;
use serde_json::{json, Value};

use crate::context::Context;
use crate::device::Device;
use crate::file;
use crate::output::Failure;
use crate::output_file;
use crate::units::hex;
use crate::values::{milliseconds, number};

/// Reads and writes memory, sets breakpoints and steps a device on the bench.
///
/// The firmware must have been built with the feature `debugger` (docs/debugger.md); no product has
/// it. Addresses are in C notation, like 0x20000000.
// The options that name the device are also accepted after the subcommand.
#[derive(Debug, Args)]
#[command(mut_args(|argument| argument.global(true)))]
pub(crate) struct Debug {
    #[command(subcommand)]
    command: Command,

    #[command(flatten)]
    device: Device,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Read memory or peripheral registers.
    Read(Read),
    /// Write RAM or peripheral registers.
    Write(Write),
    /// Set a breakpoint and wait for it; without an address, list the breakpoints.
    Break(Break),
    /// Let a stopped program continue.
    Continue(Wait),
    /// Let a stopped program execute one instruction.
    Step,
    /// Stop the program, wherever it is.
    Stop,
    /// Show the registers of a stopped program.
    Registers,
}

#[derive(Debug, Args)]
struct Read {
    /// The first address.
    #[arg(value_parser = number, value_name = "ADDRESS")]
    address: u32,

    /// The number of bytes.
    #[arg(value_parser = number, value_name = "BYTES", default_value = "4")]
    len: u32,

    /// Write the bytes to this file instead of showing them.
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct Write {
    /// The first address.
    #[arg(value_parser = number, value_name = "ADDRESS")]
    address: u32,

    /// A word of 32 bits.
    #[arg(value_parser = number, value_name = "WORD", required_unless_present_any = ["bytes", "input"])]
    word: Option<u32>,

    /// Bytes, in hexadecimal: "DE AD BE EF".
    #[arg(long, value_parser = bytes, value_name = "HEX", conflicts_with_all = ["word", "input"])]
    bytes: Option<Bytes>,

    /// The contents of this file.
    #[arg(long, short, value_name = "FILE", conflicts_with = "word")]
    input: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct Break {
    /// The instruction: an even address in flash.
    #[arg(value_parser = number, value_name = "ADDRESS")]
    address: Option<u32>,

    /// Remove this breakpoint; without an address, all breakpoints.
    #[arg(long)]
    clear: bool,

    #[command(flatten)]
    wait: Wait,
}

#[derive(Debug, Args)]
struct Wait {
    /// Wait for the program to stop, for at most this many milliseconds.
    #[arg(long, value_parser = milliseconds, value_name = "MS")]
    wait: Option<Duration>,
}

/// How long a program may take to execute an instruction or to stop.
const AT_ONCE: Duration = Duration::from_secs(2);

/// Bytes of the command line.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Bytes(Vec<u8>);

/// The result of a subcommand: for people, and for programs.
type Done = (String, Value);

impl Debug {
    pub(crate) fn run(&self, context: &Context) -> Result<(), Failure> {
        if let Command::Read(Read { output: Some(path), .. }) = &self.command {
            output_file::ready(path)?;
        }
        let mut link = context.link()?;
        let mut session = self.device.session(&mut link)?;
        let node = session.node();
        let outcome = self.command.run(&mut Debugger::new(&mut session));
        let (words, mut value) = outcome.map_err(|failure| Failure::diagnosed(failure, &mut session))?;
        value["node"] = node.get().into();
        context.result(format_args!("node {node}: {words}"), || value);
        Ok(())
    }
}

impl Command {
    fn run(&self, debugger: &mut Debugger<'_, '_>) -> Result<Done, Failure> {
        match self {
            Self::Read(read) => read.run(debugger),
            Self::Write(write) => write.run(debugger),
            Self::Break(at) => at.run(debugger),
            Self::Continue(wait) => {
                stopped_program(debugger)?;
                debugger.resume()?;
                match wait.wait {
                    Some(time) => stop(debugger, time),
                    None => Ok(("the program continues".to_string(), json!({}))),
                }
            }
            Self::Step => {
                stopped_program(debugger)?;
                debugger.step()?;
                stop(debugger, AT_ONCE)
            }
            Self::Stop => {
                debugger.stop()?;
                stop(debugger, AT_ONCE)
            }
            Self::Registers => {
                let registers = stopped_program(debugger)?;
                let named = NAMES.iter().zip(registers.0);
                let words: Vec<String> =
                    named.clone().map(|(name, value)| format!("{name} {value:08X}h")).collect();
                let value: serde_json::Map<String, Value> =
                    named.map(|(name, value)| ((*name).to_string(), value.into())).collect();
                Ok((words.join(", "), json!({ "registers": value })))
            }
        }
    }
}

fn stopped_program(debugger: &mut Debugger<'_, '_>) -> Result<Registers, Failure> {
    debugger.registers()?.ok_or_else(|| {
        Failure::usage(
            "the program is not stopped",
            "stop it with coflash more debug stop, or set a breakpoint",
        )
    })
}

/// Waits for a stop, and reports it.
fn stop(debugger: &mut Debugger<'_, '_>, time: Duration) -> Result<Done, Failure> {
    let Some(Stopped { stop, address }) = debugger.await_stop(time)? else {
        let advice =
            "the program may never reach the instruction, or the instruction lies in code that cannot be stopped (docs/debugger.md)";
        let what = format!("the program has not stopped within {} ms", time.as_millis());
        return Err(Failure::usage(what, advice));
    };
    let (words, kind) = match stop {
        Stop::Breakpoint => ("stopped at a breakpoint at", "breakpoint"),
        Stop::Step => ("stopped at", "step"),
        Stop::OutOfReach => {
            let what = format!(
                "the code at {address:08X}h cannot be stopped: breakpoints are disabled, and the program continues"
            );
            let advice = "it belongs to an interrupt above the debugger, or runs in a critical section (docs/debugger.md)";
            return Err(Failure::usage(what, advice));
        }
    };
    Ok((format!("{words} {address:08X}h"), json!({ "stopped": kind, "address": address })))
}

impl Read {
    fn run(&self, debugger: &mut Debugger<'_, '_>) -> Result<Done, Failure> {
        let bytes = debugger.read(self.address, self.len, &mut |_| {})?;
        let (address, len) = (self.address, bytes.len());
        if let Some(path) = &self.output {
            output_file::write(path, &bytes)?;
            let words = format!("{len} bytes from {address:08X}h to {}", path.display());
            let value = json!({ "address": address, "size": len, "file": path.display().to_string() });
            return Ok((words, value));
        }
        Ok((dump(address, &bytes), json!({ "address": address, "size": len, "hex": hex(&bytes, "") })))
    }
}

impl Write {
    fn run(&self, debugger: &mut Debugger<'_, '_>) -> Result<Done, Failure> {
        let bytes = match (&self.bytes, self.word, &self.input) {
            (Some(Bytes(bytes)), ..) => bytes.clone(),
            (None, Some(word), _) => word.to_le_bytes().to_vec(),
            (None, None, Some(path)) => file::bytes(path)?,
            // clap requires one of them.
            (None, None, None) => Vec::new(),
        };
        if bytes.is_empty() {
            return Err(Failure::usage("there are no bytes to write", "give a word, --bytes or --input"));
        }
        debugger.write(self.address, &bytes, &mut |_| {})?;
        let words = format!("{} bytes written to {:08X}h", bytes.len(), self.address);
        Ok((words, json!({ "address": self.address, "size": bytes.len() })))
    }
}

impl Break {
    fn run(&self, debugger: &mut Debugger<'_, '_>) -> Result<Done, Failure> {
        match (self.address, self.clear) {
            (None, true) => debugger.clear_all()?,
            (Some(address), true) => {
                if !debugger.clear(address)? {
                    let what = format!("there is no breakpoint at {address:08X}h");
                    return Err(Failure::usage(what, "list them with coflash more debug break"));
                }
            }
            (None, false) => {}
            (Some(address), false) => {
                debugger.break_at(address)?.map_err(|why| refused(address, why))?;
                if let Some(time) = self.wait.wait {
                    return stop(debugger, time);
                }
            }
        }
        let set = debugger.breakpoints()?;
        let listed: Vec<String> = set.iter().map(|address| format!("{address:08X}h")).collect();
        let words = match listed.as_slice() {
            [] => "no breakpoints".to_string(),
            _ => format!("breakpoints at {}", listed.join(", ")),
        };
        Ok((words, json!({ "breakpoints": set })))
    }
}

fn refused(address: u32, why: NoBreakpoint) -> Failure {
    match why {
        NoBreakpoint::Address => Failure::usage(
            format!("{address:08X}h cannot have a breakpoint"),
            "give the even address of an instruction in flash",
        ),
        NoBreakpoint::Full => Failure::usage(
            format!("all {BREAKPOINTS} breakpoints are taken"),
            "remove one with coflash more debug break ADDRESS --clear",
        ),
        NoBreakpoint::Disabled => Failure::usage(
            "the device does not stop at breakpoints",
            "start an application that was built with the feature `debugger`; a bootloader does not stop",
        ),
    }
}

/// Sixteen bytes on each line after their address; one word also as a number.
fn dump(address: u32, bytes: &[u8]) -> String {
    let line = |(n, bytes): (usize, &[u8])| {
        let at = address.wrapping_add(16 * n as u32);
        match <[u8; 4]>::try_from(bytes) {
            Ok(word) if n == 0 => {
                format!("{at:08X}h: {} ({:08X}h)", hex(bytes, " "), u32::from_le_bytes(word))
            }
            _ => format!("{at:08X}h: {}", hex(bytes, " ")),
        }
    };
    let lines: Vec<String> = bytes.chunks(16).enumerate().map(line).collect();
    lines.join("\n")
}

/// `DE AD BE EF`, `DEADBEEF`.
fn bytes(text: &str) -> Result<Bytes, String> {
    let wrong = || "bytes are pairs of hexadecimal digits, like \"DE AD BE EF\"".to_string();
    hex_digits(text).map(Bytes).ok_or_else(wrong)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_pairs_of_digits() {
        for words in ["DE AD be ef", "deadBEEF", " d e a d b e e f "] {
            assert_eq!(bytes(words), Ok(Bytes(vec![0xDE, 0xAD, 0xBE, 0xEF])), "{words}");
        }
        for words in ["", " ", "D", "DEA", "0x12", "GG", "+1", "é1"] {
            assert!(bytes(words).is_err(), "{words}");
        }
    }

    #[test]
    fn memory_is_shown_in_lines() {
        assert_eq!(dump(0x2000_0010, &[0xEF, 0xBE, 0xAD, 0xDE]), "20000010h: EF BE AD DE (DEADBEEFh)");
        let lines = dump(0x2000_0010, &[0xA5; 20]);
        let lines: Vec<&str> = lines.lines().collect();
        assert_eq!(lines[0], "20000010h: A5 A5 A5 A5 A5 A5 A5 A5 A5 A5 A5 A5 A5 A5 A5 A5");
        assert_eq!(lines[1..], ["20000020h: A5 A5 A5 A5"]);
    }
}
