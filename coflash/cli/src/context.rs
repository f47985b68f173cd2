//! The values that every command gets, and access to the bus.

use std::fmt;
use std::path::PathBuf;

use canopen::NodeId;
use clap::Args;
use coboot_can::{trace, Adapter, Kind, Link, SdoIds};
use coflash_core::device::lock::Lock;
use serde_json::Value;

use super::output::{Failure, Output};
use super::record;
use super::search::{only, Kinds};
use super::values::base_id;
use super::waiting::Waiting;

/// The options that every command has.
#[derive(Clone, Debug, Args)]
#[command(next_help_heading = "For all commands")]
pub(super) struct Context {
    /// The CAN bus: socketcan:INTERFACE (on Linux), slcan:PORT@BITRATE,
    /// slcan:tcp://HOST:PORT@BITRATE, peak:CHANNEL@BITRATE, kvaser:NUMBER@BITRATE,
    /// gs_usb:NUMBER@BITRATE or socketcand://HOST:PORT/BUS; or a gateway to it:
    /// cia309://HOST:PORT/NET. The default is the only adapter of this computer.
    #[arg(long, global = true, env = "COFLASH_BUS", value_name = "URL")]
    pub(super) bus: Option<String>,

    /// The kinds of adapters to search for, with the command adapters and if no --bus is given:
    /// serial, socketcan, peak, kvaser, gs_usb, socketcand (separated by commas), or none.
    #[arg(long, global = true, env = "COFLASH_SEARCH", value_name = "KINDS", value_parser = Kinds::parse, hide_short_help = true)]
    pub(super) search: Option<Kinds>,

    /// A file with defaults for options; by default coflash.toml in the current folder, or the
    /// user's own file.
    #[arg(long, global = true, env = "COFLASH_CONFIG", value_name = "FILE", hide_short_help = true)]
    pub(super) config: Option<PathBuf>,

    /// Write all frames to this file in the format of candump -L; monitor --replay shows it in
    /// words.
    #[arg(long, global = true, value_name = "FILE", hide_short_help = true)]
    pub(super) trace: Option<PathBuf>,

    /// Write everything that happens to this file, with time stamps: events, messages and frames,
    /// but no passwords.
    #[arg(long, global = true, value_name = "FILE", hide_short_help = true)]
    pub(super) log_file: Option<PathBuf>,

    /// Create a folder in this folder with everything that a service department needs: versions,
    /// command line, events, log and trace, but no passwords.
    #[arg(long, global = true, value_name = "FOLDER", hide_short_help = true)]
    pub(super) report_dir: Option<PathBuf>,

    /// The base COB-ID of SDO requests, to which the node-ID is added, for devices that do not
    /// listen on 0x600 (BLCOP_BASE_REQUEST of the manual).
    #[arg(long, global = true, value_name = "COB-ID", value_parser = base_id, hide_short_help = true)]
    sdo_request: Option<u16>,

    /// The base COB-ID of SDO answers, to which the node-ID is added, in place of 0x580
    /// (BLCOP_BASE_RESPONSE of the manual).
    #[arg(long, global = true, value_name = "COB-ID", value_parser = base_id, hide_short_help = true)]
    sdo_response: Option<u16>,

    #[command(flatten)]
    pub(super) out: Output,

    /// The names of the command and its subcommands, with a blank between them.
    #[arg(skip)]
    pub(super) command: String,
}

impl Context {
    /// These options, of one line of the shell; those that are not given are the shell's own.
    pub(super) fn or(self, shell: &Self) -> Self {
        Self {
            bus: self.bus.or_else(|| shell.bus.clone()),
            search: self.search.or_else(|| shell.search.clone()),
            trace: self.trace.or_else(|| shell.trace.clone()),
            sdo_request: self.sdo_request.or(shell.sdo_request),
            sdo_response: self.sdo_response.or(shell.sdo_response),
            out: self.out.or(shell.out),
            command: self.command,
            ..shell.clone()
        }
    }

    /// Prints the result of the command: words for people, the value with the command's name for
    /// programs.
    pub(super) fn result(&self, words: impl fmt::Display, value: impl FnOnce() -> Value) {
        self.out.result(words, || self.named(value()));
    }

    /// Prints the result of a command that has shown its words.
    pub(super) fn value(&self, value: Value) {
        self.out.value(&self.named(value));
    }

    fn named(&self, mut value: Value) -> Value {
        if let Value::Object(values) = &mut value {
            values.insert("command".into(), self.command.as_str().into());
        }
        value
    }

    /// The base COB-IDs of SDO requests and answers, if they differ from the predefined ones.
    pub(super) fn sdo_ids(&self) -> Option<(u16, u16)> {
        match (self.sdo_request, self.sdo_response) {
            (None, None) => None,
            (request, response) => Some((request.unwrap_or(0x600), response.unwrap_or(0x580))),
        }
    }

    /// The CAN bus.
    pub(super) fn open(&self) -> Result<Box<dyn Adapter + Send>, Failure> {
        let adapter = coboot_can::open(&self.url(self.bus.as_deref())?)?;
        self.traced(adapter)
    }

    /// Access to devices: the CAN bus, or a gateway.
    pub(super) fn link(&self) -> Result<Link, Failure> {
        self.link_at(self.bus.as_deref(), None)
    }

    /// Access through this bus. `bit_rate` applies if the URL contains none and the adapter sets
    /// the bit rate.
    pub(super) fn link_at(&self, bus: Option<&str>, bit_rate: Option<u32>) -> Result<Link, Failure> {
        match Link::open(&self.url(bus)?, bit_rate)? {
            Link::Bus(adapter) => Ok(Link::Bus(self.traced(adapter)?)),
            gateway => {
                if self.trace.is_some() {
                    self.out.warn("a gateway shows no frames: the trace file stays empty");
                }
                Ok(gateway)
            }
        }
    }

    /// The kinds of adapters to search for.
    pub(super) fn kinds(&self) -> Vec<Kind> {
        self.search.as_ref().map_or_else(|| Kind::ALL.to_vec(), |kinds| kinds.0.clone())
    }

    /// The given bus, or the bus of the only adapter.
    pub(super) fn url(&self, bus: Option<&str>) -> Result<String, Failure> {
        match bus {
            Some(bus) => Ok(bus.to_string()),
            None => only(self.out, &self.kinds()),
        }
    }

    /// Locks the node, so that no other process of this computer works on it.
    pub(super) fn lock(&self, bus: Option<&str>, node: NodeId) -> Result<Lock, Failure> {
        Ok(Lock::of(&self.url(bus)?, node)?)
    }

    /// Shows what the tool waits for, as in "node 5 answers", until the value is dropped.
    pub(super) fn waiting(&self, what: impl Into<String>) -> Waiting {
        Waiting::new(self.out, what)
    }

    fn traced(&self, adapter: Box<dyn Adapter + Send>) -> Result<Box<dyn Adapter + Send>, Failure> {
        let traced: Box<dyn Adapter + Send> = match &self.trace {
            Some(path) => {
                let (out, name) = (self.out, path.display().to_string());
                let failed = move |error| out.warn(format_args!("{name}: writing failed: {error}"));
                Box::new(trace(adapter, path, Box::new(failed))?)
            }
            None => adapter,
        };
        // Passwords are recognised by the usual COB-IDs, so records are taken after the
        // translation of COB-IDs.
        Ok(record::tapped(match self.sdo_ids() {
            None => traced,
            Some((request, response)) => Box::new(SdoIds::new(traced, request, response)),
        }))
    }
}
