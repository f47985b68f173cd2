//! A client of an Eclipse hawkBit server (Direct Device Integration API): takes the deployments for
//! the devices of its buses, flashes them, and reports progress and result of each device.
//!
//! | file | what is in it |
//! |---|---|
//! | `config` | the devices and the server, from a TOML file |
//! | `url` | which URLs belong to the server, and get its token |
//! | `ddi` | the messages of the interface |
//! | `pause` | the pause between two polls, in the forms that a server sends |
//! | `backoff` | pauses that grow, with jitter |
//! | `record` | what an agent must know after a restart |
//! | `controller` | what one device does next: a state machine without I/O |
//! | `http` | requests to the server, with limits |
//! | `download` | artifacts: fetched piece by piece, checked |
//! | `firmware` | the artifact as a program of a device, or as a package for a machine |
//! | `buses` | the devices, and those of machines |
//! | `progress` | what the server hears of an update |
//! | `machine` | an update with a package, in words for the server |
//! | `run` | a thread for each target, which joins these parts |
//!
//! Nothing is flashed whose size and SHA-256 were not compared with the deployment.
#![forbid(unsafe_code)]

mod backoff;
mod buses;
mod config;
mod controller;
mod ddi;
mod download;
mod firmware;
mod http;
mod machine;
mod pause;
mod progress;
mod record;
mod run;
mod url;

pub use self::buses::{Buses, Open};
pub use self::config::{Config, Device, Fault, Machine, Target, TargetKind};
pub use self::controller::{Flashed, Kind, Message, News};
pub use self::firmware::Content;
pub use self::run::{run, CannotStart, Devices, Ended, Options, Order, Times};

/// The example on the crate's page compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
