//! `coflash lss`: sets node-ID and bit rate over the bus.

use std::time::Duration;

use canopen::nmt::NmtCommand;
use canopen::NodeId;
use clap::{Args, Subcommand};
use coboot_can::Adapter;
use coflash_core::device::lss::{BitRate, LssAddress, Master};
use coflash_core::Error;
use serde_json::{json, Value};

use super::context::Context;
use super::device::cancelled;
use super::output::Failure;
use super::values::{milliseconds, node_id, number};

/// Sets node-ID and bit rate over the bus (LSS).
///
/// These are the layer setting services of CiA 305.
/// There must be no other LSS master on the bus.
#[derive(Debug, Args)]
pub(super) struct Lss {
    #[command(subcommand)]
    service: Service,

    /// How long a device may take for its answer, in milliseconds. Fastscan takes up to 128 times
    /// as long.
    #[arg(long, global = true, default_value = "100", value_parser = milliseconds, value_name = "MS")]
    lss_timeout: Duration,
}

#[derive(Debug, Subcommand)]
enum Service {
    /// Find devices without a node-ID, and give them one if --assign is given.
    Fastscan(Fastscan),
    /// Give a device a node-ID.
    Assign(Assign),
    /// Give a device a bit rate.
    BitRate(SetBitRate),
    /// Make a device store its node-ID and bit rate.
    Store(Selected),
    /// Ask a device for its LSS address and node-ID.
    Inquire(Selected),
}

/// The options that select a device. Without them the command addresses the only device on the bus.
#[derive(Clone, Copy, Debug, Args)]
struct Selected {
    /// Its vendor-ID (1018h/1).
    #[arg(long, value_parser = number, value_name = "NUMBER", requires_all = ["product", "revision", "serial"])]
    vendor: Option<u32>,
    /// Its product code (1018h/2).
    #[arg(long, alias = "pcode", value_parser = number, value_name = "NUMBER", requires = "vendor")]
    product: Option<u32>,
    /// Its revision (1018h/3).
    #[arg(long, alias = "rev", value_parser = number, value_name = "NUMBER", requires = "vendor")]
    revision: Option<u32>,
    /// Its serial number (1018h/4).
    #[arg(long, alias = "ser_num", value_parser = number, value_name = "NUMBER", requires = "vendor")]
    serial: Option<u32>,
}

#[derive(Debug, Args)]
struct Fastscan {
    /// Give the devices node-IDs from this one upwards, in the order in which they are found.
    #[arg(long, value_parser = node_id, value_name = "1..127")]
    assign: Option<NodeId>,

    /// Make the devices store their node-IDs.
    #[arg(long, requires = "assign")]
    store: bool,
}

#[derive(Debug, Args)]
struct Assign {
    /// The node-ID to give.
    #[arg(long, short = 'N', alias = "node_id", value_parser = node_id, value_name = "1..127", required_unless_present = "none")]
    node: Option<NodeId>,

    /// Take the node-ID from the device.
    #[arg(long, conflicts_with = "node")]
    none: bool,

    /// Make the device store the node-ID.
    #[arg(long)]
    store: bool,

    /// Reset the communication of a device that had another node-ID, so that the new one takes
    /// effect at once.
    #[arg(long)]
    reset: bool,

    #[command(flatten)]
    device: Selected,
}

#[derive(Debug, Args)]
struct SetBitRate {
    /// The bit rate in kbit/s: 1000, 800, 500, 250, 125, 100, 50, 20 or 10.
    #[arg(value_name = "KBITS", value_parser = bit_rate)]
    rate: BitRate,

    /// Switch the bit rate now, after this many milliseconds of silence; afterwards set the
    /// adapter's bit rate, too.
    #[arg(long, value_name = "MS", value_parser = milliseconds, num_args = 0..=1, default_missing_value = "500")]
    activate: Option<Duration>,

    /// Make the device store the bit rate.
    #[arg(long)]
    store: bool,

    #[command(flatten)]
    device: Selected,
}

impl Selected {
    /// The address, if the user gave all of it (clap checks "all or nothing").
    fn address(self) -> Option<LssAddress> {
        Some(LssAddress {
            vendor_id: self.vendor?,
            product_code: self.product?,
            revision: self.revision?,
            serial_number: self.serial?,
        })
    }

    /// Switches the device into configuration state.
    fn select(self, master: &mut Master<'_>) -> Result<(), Error> {
        master.switch_all(false)?;
        match self.address() {
            Some(address) => master.select(&address),
            None => master.switch_all(true),
        }
    }
}

impl Lss {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        let mut adapter = context.open()?;
        let waiting = context.waiting("the devices have answered");
        let done = {
            let mut master = self.master(&mut *adapter)?;
            let done = match &self.service {
                Service::Fastscan(fastscan) => Ok(fastscan.run(&mut master, context)),
                Service::Assign(assign) => assign.run(&mut master),
                Service::BitRate(rate) => rate.run(&mut master),
                Service::Store(device) => device.store(&mut master),
                Service::Inquire(device) => device.inquire(&mut master),
            };
            // A device that has switched its bit rate is silent and already in waiting state.
            let back = master.switch_all(false);
            let done = done?;
            if done.ended.is_ok() {
                back?;
            }
            done
        };
        if let Some(node) = done.reset {
            adapter.send(&NmtCommand::ResetCommunication.emit(Some(node)))?;
        }
        drop(waiting);
        let (mut value, ended) = (done.value, done.ended);
        let ended = ended.map_err(|failure| failure.within(&mut value));
        context.result(done.words, || value);
        ended
    }

    fn master<'a>(&self, adapter: &'a mut dyn Adapter) -> Result<Master<'a>, Failure> {
        let mut master = Master::new(adapter, self.lss_timeout);
        master.cancel_by(cancelled()?);
        Ok(master)
    }
}

/// The result of a service.
struct Done {
    words: String,
    value: Value,
    /// The node-ID of the device whose communication must be reset.
    reset: Option<NodeId>,
    /// Why it has ended early, if it has: what was done until then is told all the same.
    ended: Result<(), Failure>,
}

impl Done {
    fn new(words: String, value: Value) -> Self {
        Self { words, value, reset: None, ended: Ok(()) }
    }
}

impl Fastscan {
    fn run(&self, master: &mut Master<'_>, context: &Context) -> Done {
        let mut found = Vec::new();
        let ended = self.search(master, &mut |line, device| {
            context.out.detail(&line);
            found.push((line, device));
        });
        let (mut words, devices): (Vec<String>, Vec<Value>) = found.into_iter().unzip();
        if words.is_empty() && ended.is_ok() {
            words.push("no device without a node-ID".to_string());
        }
        Done { ended, ..Done::new(words.join("\n"), json!({ "devices": devices })) }
    }

    /// Tells each device as soon as it has what it is to get.
    fn search(&self, master: &mut Master<'_>, told: &mut dyn FnMut(String, Value)) -> Result<(), Failure> {
        let mut next = self.assign;
        master.switch_all(false)?;
        while let Some(address) = master.fastscan(&mut |_| {})? {
            let (mut line, mut device) = (shown(&address), value(&address));
            if self.assign.is_some() {
                let Some(node) = next else {
                    told(format!("{line}: no node-ID"), device);
                    return Err(Failure::no_node_id_left());
                };
                master.set_node_id(Some(node))?;
                line = format!("{line}: node {node} from now on");
                device["node"] = node.get().into();
                next = NodeId::new(node.get() + 1);
            }
            // From here on the device has it, whatever comes.
            told(line, device);
            if self.store {
                master.store()?;
            }
            // In waiting state the device takes its node-ID and boots. A device without one would
            // be found again.
            master.switch_all(false)?;
            if self.assign.is_none() {
                break;
            }
        }
        Ok(())
    }
}

impl Assign {
    fn run(&self, master: &mut Master<'_>) -> Result<Done, Error> {
        self.device.select(master)?;
        let old = master.inquire_node_id()?;
        master.set_node_id(self.node)?;
        if self.store {
            master.store()?;
        }
        let given = match self.node {
            Some(node) => format!("the device has node-ID {node}"),
            None => "the device has no node-ID".to_string(),
        };
        let reset = old.filter(|old| self.reset && Some(*old) != self.node);
        let when = match old {
            Some(old) if self.node == Some(old) => ", unchanged".to_string(),
            None => " from now on".to_string(),
            Some(_) if reset.is_some() => " from now on".to_string(),
            Some(old) => format!(", effective after coflash reset --communication --node {old}"),
        };
        let value = json!({ "node": self.node.map(NodeId::get), "old": old.map(NodeId::get) });
        Ok(Done { reset, ..Done::new(format!("{given}{when}"), value) })
    }
}

impl SetBitRate {
    fn run(&self, master: &mut Master<'_>) -> Result<Done, Error> {
        self.device.select(master)?;
        master.set_bit_rate(self.rate)?;
        if self.store {
            master.store()?;
        }
        let rate = self.rate.bits_per_second().unwrap_or_default();
        let when = match self.activate {
            Some(delay) => {
                master.activate(delay)?;
                format!("switches to it after {} ms", delay.as_millis())
            }
            None if self.store => "switches to it at its next start".to_string(),
            None => "does not switch to it yet".to_string(),
        };
        let words = format!("the device is given {} kbit/s and {when}", rate / 1000);
        Ok(Done::new(words, json!({ "bit_rate": rate, "activated": self.activate.is_some() })))
    }
}

impl Selected {
    fn store(self, master: &mut Master<'_>) -> Result<Done, Error> {
        self.select(master)?;
        master.store()?;
        Ok(Done::new("node-ID and bit rate are stored".to_string(), json!({})))
    }

    fn inquire(self, master: &mut Master<'_>) -> Result<Done, Error> {
        self.select(master)?;
        let address = master.inquire_address()?;
        let node = master.inquire_node_id()?;
        let words = match node {
            Some(node) => format!("{}: node {node}", shown(&address)),
            None => format!("{}: no node-ID", shown(&address)),
        };
        let mut value = value(&address);
        value["node"] = node.map(NodeId::get).into();
        Ok(Done::new(words, value))
    }
}

fn shown(address: &LssAddress) -> String {
    let LssAddress { vendor_id, product_code, revision, serial_number } = address;
    format!("vendor {vendor_id:08X}h, product {product_code:08X}h, revision {revision:08X}h, serial {serial_number:08X}h")
}

fn value(address: &LssAddress) -> Value {
    json!({
        "vendor_id": address.vendor_id,
        "product_code": address.product_code,
        "revision": address.revision,
        "serial_number": address.serial_number,
    })
}

pub(super) fn bit_rate(text: &str) -> Result<BitRate, String> {
    let rate = number(text)?.checked_mul(1000);
    (0..=8)
        .filter_map(BitRate::from_index)
        .find(|known| known.bits_per_second() == rate)
        .ok_or_else(|| "LSS knows 1000, 800, 500, 250, 125, 100, 50, 20 and 10 kbit/s".to_string())
}
