//! One station of a production line, as a template: downloads a program into the only device on the
//! bench.
//!
//! ```text
//! production_line BUS BOARD FILE NODE [--lss]
//! ```
//!
//! `BUS` is a URL as for `coflash --bus`, `BOARD` the name of a board, `FILE` the firmware and
//! `NODE` the node-ID. With `--lss` the device has no node-ID yet: LSS fastscan finds it, and it
//! gets this node-ID.
//!
//! Events are written to standard output, one JSON object on each line (docs/coflash.md has the
//! names). The exit code shows what to check: 0 the device is good, 1 the station is set up wrong
//! (arguments, file, adapter), 2 the device is defective.

use std::env;
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;

use canopen::NodeId;
use coboot_can::Adapter;
use coflash_core::device::lss::{ensure_node_id, Master, ANSWER};
use coflash_core::device::{info, Error, Session, Timing};
use coflash_core::file::convert::{program_of, Options, Region};
use coflash_core::file::{self, Program};
use coflash_core::update::event::Problem;
use coflash_core::update::{flash, FlashOptions};
use serde_json::json;

/// Why the station has produced no good device.
#[derive(Debug)]
enum Stop {
    /// The station is set up wrong.
    Station(String),
    /// The device is defective, or the bus to it.
    Device(Error),
}

impl From<Error> for Stop {
    fn from(error: Error) -> Self {
        match error {
            Error::Adapter(error) => Self::Station(format!("{error}; {}", error.advice())),
            error => Self::Device(error),
        }
    }
}

/// The task of the station.
#[derive(Debug)]
struct Order {
    bus: String,
    node: NodeId,
    /// Whether the device must get its node-ID first.
    lss: bool,
    program: Program,
}

impl Order {
    /// Parses the arguments and reads the program. All errors of the set-up are found here, before
    /// a device is used.
    fn new(arguments: &[String]) -> Result<Self, Stop> {
        let station = |what: String| Stop::Station(what);
        let (bus, board, path, node, lss) = match arguments {
            [bus, board, path, node] => (bus, board, path, node, false),
            [bus, board, path, node, word] if word == "--lss" => (bus, board, path, node, true),
            _ => return Err(station("usage: production_line BUS BOARD FILE NODE [--lss]".to_string())),
        };
        let node = node.parse().ok().and_then(NodeId::new);
        let node = node.ok_or_else(|| station("the node-ID must be 1 to 127".to_string()))?;
        let layout = file::board::named(board).map_err(|error| station(error.to_string()))?;
        let region = Region::Strict(layout.programs[0].into());
        let firmware = file::load(Path::new(path), None, None).map_err(|error| station(error.to_string()))?;
        let converted = program_of(firmware, &Options::default().region(region));
        let program = converted.map_err(|error| station(format!("{path}: {error}")))?.program;
        Ok(Self { bus: bus.clone(), node, lss, program })
    }

    /// The whole task; `tell` gets each line.
    fn carry_out(&self, tell: &mut dyn FnMut(serde_json::Value)) -> Result<(), Stop> {
        let mut bus = coboot_can::open(&self.bus).map_err(Error::from)?;
        if self.lss {
            self.commission(&mut *bus)?;
        }
        let mut session = Session::new(&mut *bus, self.node, Timing::default());
        // `verify`: the running program must report the CRC of the file, too.
        let options = FlashOptions::default().verify(true);
        flash(&mut session, &self.program, &options, &mut |event| tell(json!(event.line(self.node))))?;
        // For the record of this device: serial number, versions, CRC.
        tell(json!({ "device": info(&mut session)? }));
        Ok(())
    }

    /// Sets and stores this node-ID of the only device without one.
    fn commission(&self, bus: &mut dyn Adapter) -> Result<(), Stop> {
        let mut master = Master::new(&mut *bus, ANSWER);
        master.switch_all(false)?;
        let found = master.fastscan(&mut |_| {})?;
        let nobody = || Stop::Station("no device without a node-ID is on the bus".to_string());
        let address = found.ok_or_else(nobody)?;
        let boot = Timing::default().boot;
        ensure_node_id(bus, &address, Some(self.node), boot, &Arc::default())?;
        Ok(())
    }
}

/// Carries out the task; returns the exit code.
fn run(arguments: &[String], tell: &mut dyn FnMut(serde_json::Value)) -> u8 {
    match Order::new(arguments).and_then(|order| order.carry_out(tell)) {
        Ok(()) => 0,
        Err(Stop::Station(what)) => {
            tell(json!({ "station": what }));
            1
        }
        Err(Stop::Device(error)) => {
            tell(json!({ "error": Problem::of(&error) }));
            2
        }
    }
}

fn main() -> ExitCode {
    let arguments: Vec<String> = env::args().skip(1).collect();
    ExitCode::from(run(&arguments, &mut |line| println!("{line}")))
}
