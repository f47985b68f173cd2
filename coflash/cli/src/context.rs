//! The values that every command gets, and access to the bus.

use std::path::PathBuf;

use canopen::NodeId;
use coboot_can::{trace, Adapter, Kind, Link, SdoIds};
use coflash_core::device::lock::Lock;

use super::output::{Failure, Output};
use super::record;
use super::search::{only, Kinds};
use super::waiting::Waiting;

/// The values that every command gets.
pub(super) struct Context {
    /// The value of `--bus`, `COFLASH_BUS` or the configuration.
    pub(super) bus: Option<String>,
    /// The value of `--search`.
    pub(super) search: Option<Kinds>,
    pub(super) trace: Option<PathBuf>,
    /// The base COB-IDs of SDO requests and answers, without the node-ID, if they differ from the
    /// predefined ones.
    pub(super) sdo_request: Option<u16>,
    pub(super) sdo_response: Option<u16>,
    /// The configuration file that `--config` or `COFLASH_CONFIG` names.
    pub(super) config: Option<PathBuf>,
    /// The value of `--report-dir`.
    pub(super) report_dir: Option<PathBuf>,
    pub(super) out: Output,
}

impl Context {
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
        Ok(record::tapped(match (self.sdo_request, self.sdo_response) {
            (None, None) => traced,
            (request, response) => {
                Box::new(SdoIds::new(traced, request.unwrap_or(0x600), response.unwrap_or(0x580)))
            }
        }))
    }
}
