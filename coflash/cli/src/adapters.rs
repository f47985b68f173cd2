//! `coflash adapters`: lists the adapters of this computer.

use std::fmt;
use std::time::Duration;

use clap::Args;
use coboot_can::{list, Found, List, State};
use serde_json::{json, Value};

use super::context::Context;
use super::output::Failure;
use super::units::table;
use super::values::milliseconds;

/// Lists the CAN adapters of this computer.
///
/// They are serial ports, CAN interfaces of Linux, PEAK and Kvaser channels, gs_usb devices, and
/// socketcand servers that announce themselves on the network.
///
/// Without --bus the other commands use the only adapter, if there is exactly one. They never
/// choose a serial port, which may lead to any device, or a server on the network by themselves.
#[derive(Debug, Args)]
pub(super) struct Adapters {
    /// How long to listen for socketcand servers, in milliseconds; they announce themselves every
    /// 3 s.
    #[arg(long, value_parser = milliseconds, value_name = "MS", default_value = "3100")]
    listen: Duration,
}

impl Adapters {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        context.out.detail("looking for adapters, and listening for servers on the network");
        let list = list(&context.kinds(), self.listen);
        for (kind, missing) in &list.missing {
            context.out.detail(format_args!("{kind}: {}; {}", missing.what, missing.advice));
        }
        context.result(Table(&list), || value(&list));
        Ok(())
    }
}

/// A line for each adapter, and one for the kinds that could not be searched for.
struct Table<'l>(&'l List);

impl fmt::Display for Table<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let List { found, missing } = self.0;
        if found.is_empty() {
            writeln!(f, "no adapter was found: plug one in, or name a server on the network with --bus")?;
        } else {
            let head = ["--bus", "what it is", "bit rate", "state"].map(str::to_string);
            let rows: Vec<[String; 4]> = std::iter::once(head).chain(found.iter().map(row)).collect();
            f.write_str(&table(&rows))?;
        }
        if !missing.is_empty() {
            let kinds: Vec<&str> = missing.iter().map(|(kind, _)| kind.name()).collect();
            write!(f, "not searched for: {} (--verbose shows why)", kinds.join(", "))?;
        }
        Ok(())
    }
}

fn row(found: &Found) -> [String; 4] {
    let none = || "-".to_string();
    let rate = found.bit_rate.map_or_else(none, |rate| format!("{} kbit/s", f64::from(rate) / 1000.0));
    let about = Some(found.about.clone()).filter(|about| !about.is_empty()).unwrap_or_else(none);
    [found.url.clone(), about, rate, found.state.map_or_else(none, |state| state.words().to_string())]
}

/// The JSON value.
pub(super) fn value(list: &List) -> Value {
    let found = |found: &Found| {
        json!({
            "bus": found.url,
            "kind": found.kind.name(),
            "about": found.about,
            "bit_rate": found.bit_rate,
            "state": found.state.map(State::words),
            "taken_unasked": found.certain,
        })
    };
    let adapters: Vec<Value> = list.found.iter().map(found).collect();
    let missing = list.missing.iter();
    let missing =
        missing.map(|(kind, why)| json!({ "kind": kind.name(), "what": why.what, "advice": why.advice }));
    json!({ "adapters": adapters, "not_looked_for": missing.collect::<Vec<_>>() })
}
