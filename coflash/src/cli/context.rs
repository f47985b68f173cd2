//! What every command is given, and its way to the bus.

use std::path::PathBuf;

use canopen::NodeId;
use coflash::bus::{self, Adapter, Kind, Link, SdoIds, Trace};
use coflash::device::lock::Lock;

use super::output::{Failure, Output};
use super::record;
use super::search::{only, Kinds};
use super::waiting::Waiting;

/// What every command is given.
pub(super) struct Context {
    /// What `--bus`, `COFLASH_BUS` or the configuration says.
    pub(super) bus: Option<String>,
    /// What `--search` says.
    pub(super) search: Option<Kinds>,
    pub(super) trace: Option<PathBuf>,
    /// COB-IDs of SDO requests and answers, without the node-ID, where they are not the usual ones.
    pub(super) sdo_request: Option<u16>,
    pub(super) sdo_response: Option<u16>,
    /// The configuration file that `--config` or `COFLASH_CONFIG` names.
    pub(super) config: Option<PathBuf>,
    pub(super) out: Output,
}

impl Context {
    /// The CAN bus.
    pub(super) fn open(&self) -> Result<Box<dyn Adapter + Send>, Failure> {
        let adapter = bus::open(&self.url(self.bus.as_deref())?)?;
        self.traced(adapter)
    }

    /// A way to devices: the CAN bus, or a gateway.
    pub(super) fn link(&self) -> Result<Link, Failure> {
        self.link_at(self.bus.as_deref(), None)
    }

    /// The same to this bus, at this bit rate if the URL names none and the adapter sets it.
    pub(super) fn link_at(&self, bus: Option<&str>, bit_rate: Option<u32>) -> Result<Link, Failure> {
        match Link::open(&self.url(bus)?, bit_rate)? {
            Link::Bus(adapter) => Ok(Link::Bus(self.traced(adapter)?)),
            gateway => {
                if self.trace.is_some() {
                    self.out.warn("a gateway shows no frames: nothing is traced");
                }
                Ok(gateway)
            }
        }
    }

    /// The kinds of adapters that are looked for.
    pub(super) fn kinds(&self) -> Vec<Kind> {
        self.search.as_ref().map_or_else(|| Kind::ALL.to_vec(), |kinds| kinds.0.clone())
    }

    /// The bus that is given, or that of the only adapter that is there.
    fn url(&self, bus: Option<&str>) -> Result<String, Failure> {
        match bus {
            Some(bus) => Ok(bus.to_string()),
            None => only(self.out, &self.kinds()),
        }
    }

    /// Sees to it that no other process of this computer is at work on the node.
    pub(super) fn lock(&self, bus: Option<&str>, node: NodeId) -> Result<Lock, Failure> {
        Ok(Lock::of(&self.url(bus)?, node)?)
    }

    /// Shows what is waited for, as in "node 5 answers", until it is dropped.
    pub(super) fn waiting(&self, what: impl Into<String>) -> Waiting {
        Waiting::new(self.out, what)
    }

    fn traced(&self, adapter: Box<dyn Adapter + Send>) -> Result<Box<dyn Adapter + Send>, Failure> {
        let traced: Box<dyn Adapter + Send> = match &self.trace {
            Some(path) => {
                let (out, name) = (self.out, path.display().to_string());
                let failed =
                    move |error| out.warn(format_args!("{name}: cannot be written any more: {error}"));
                Box::new(Trace::new(adapter, path, Box::new(failed))?)
            }
            None => adapter,
        };
        // Passwords are known by the usual COB-IDs: what is kept for service is taken behind these.
        Ok(record::tapped(match (self.sdo_request, self.sdo_response) {
            (None, None) => traced,
            (request, response) => {
                Box::new(SdoIds::new(traced, request.unwrap_or(0x600), response.unwrap_or(0x580)))
            }
        }))
    }
}
