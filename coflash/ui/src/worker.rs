//! The thread that owns the bus: it opens the adapter, listens while no task is running, and runs
//! one task at a time. Pages come and go; the thread stays.

use std::panic::{catch_unwind, AssertUnwindSafe};
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::advice;
use super::frames::recorded;
use super::shared::{Order, Shared};
use super::state::{Adapter, Connection, Notice};
use coboot_can::{bit_rate_of, AdapterError, Link, SdoIds};
use coflash_core::device::Timing;

/// How long the thread listens before it checks for an order.
const SLICE: Duration = Duration::from_millis(50);
/// The pause before a lost adapter is opened again.
const AGAIN: Duration = Duration::from_secs(1);

/// The base COB-IDs of SDO requests and answers, without the node-ID.
type SdoBases = (u16, u16);

/// The adapter.
enum Bus {
    Closed,
    Open {
        url: String,
        link: Link,
    },
    /// It is lost; the time of the next attempt.
    Lost {
        url: String,
        next: Instant,
    },
}

/// Works until the order to end.
pub(super) fn run(shared: &Arc<Shared>, orders: &Receiver<Order>, sdo_ids: Option<SdoBases>) {
    let mut bus = Bus::Closed;
    loop {
        let order = match &mut bus {
            // The wait of the adapter serves as the pause.
            Bus::Open { link: Link::Bus(_), .. } => orders.recv_timeout(Duration::ZERO),
            Bus::Closed | Bus::Lost { .. } | Bus::Open { .. } => orders.recv_timeout(SLICE),
        };
        bus = match (order, bus) {
            (Ok(Order::End) | Err(RecvTimeoutError::Disconnected), _) => return,
            (Ok(Order::Open(url)), _) => open(shared, url, sdo_ids),
            (Ok(Order::Close), _) => {
                shared.change(|state| state.adapter = Adapter::default());
                Bus::Closed
            }
            (Ok(Order::Run(work)), Bus::Open { url, mut link }) => {
                // After an internal error the page must not wait forever.
                let done = catch_unwind(AssertUnwindSafe(|| work.run(&mut link, shared)));
                let notice = done.unwrap_or_else(|_| {
                    Notice::failed(
                        "there was an internal error of coflash",
                        "start coflash again and report it",
                    )
                });
                shared.change(|state| {
                    state.task = None;
                    state.notice(notice);
                });
                Bus::Open { url, link }
            }
            (Ok(Order::Run(_)), bus) => {
                shared.change(|state| {
                    state.task = None;
                    state.notice(Notice::failed("the adapter is gone", "wait until it is back"));
                });
                bus
            }
            (Err(RecvTimeoutError::Timeout), Bus::Open { url, link }) => listen(shared, url, link),
            (Err(RecvTimeoutError::Timeout), Bus::Lost { url, next }) if next <= Instant::now() => {
                reopen(shared, url, sdo_ids)
            }
            (Err(RecvTimeoutError::Timeout), bus) => bus,
        };
    }
}

/// Opens an adapter with a tap for its frames.
fn link(shared: &Shared, url: &str, sdo_ids: Option<SdoBases>) -> Result<Link, AdapterError> {
    Ok(match Link::open(url, None)? {
        Link::Bus(adapter) => {
            let tap = recorded(adapter, shared.frames.clone(), shared.arrived.clone());
            match sdo_ids {
                None => Link::Bus(Box::new(tap)),
                Some((request, response)) => Link::Bus(Box::new(SdoIds::new(tap, request, response))),
            }
        }
        Link::Gateway(mut gateway) => {
            // Any server accepts a connection.
            gateway.greet(Timing::default().sdo)?;
            Link::Gateway(gateway)
        }
    })
}

fn open(shared: &Shared, url: String, sdo_ids: Option<SdoBases>) -> Bus {
    shared.change(|state| {
        state.adapter = Adapter { url: url.clone(), state: Connection::Opening, ..Adapter::default() };
        state.devices = None;
        state.notice = None;
    });
    match link(shared, &url, sdo_ids) {
        Ok(link) => opened(shared, url, link),
        Err(error) => {
            shared.change(|state| {
                state.adapter.state = Connection::Closed;
                state.notice(Notice::failed(error.to_string(), advice::on_page(&(&error).into())));
            });
            Bus::Closed
        }
    }
}

fn opened(shared: &Shared, url: String, link: Link) -> Bus {
    shared.change(|state| {
        state.adapter.state = Connection::Open;
        state.adapter.words = None;
        state.adapter.gateway = matches!(link, Link::Gateway(_));
        state.adapter.bit_rate = bit_rate_of(&url);
    });
    Bus::Open { url, link }
}

fn lost(shared: &Shared, url: String, error: &AdapterError) -> Bus {
    shared.change(|state| {
        state.adapter.state = Connection::Lost;
        state.adapter.words = Some(error.to_string());
    });
    Bus::Lost { url, next: Instant::now() + AGAIN }
}

fn reopen(shared: &Shared, url: String, sdo_ids: Option<SdoBases>) -> Bus {
    match link(shared, &url, sdo_ids) {
        Ok(link) => opened(shared, url, link),
        Err(error) => lost(shared, url, &error),
    }
}

/// Receives the frames of the bus. The tap records them.
fn listen(shared: &Shared, url: String, mut link: Link) -> Bus {
    let Link::Bus(adapter) = &mut link else { return Bus::Open { url, link } };
    match adapter.receive(SLICE) {
        Ok(_) => Bus::Open { url, link },
        Err(error) => {
            // Close the adapter before it is opened again.
            drop(link);
            lost(shared, url, &error)
        }
    }
}
