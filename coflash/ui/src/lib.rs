//! The page in the browser: a server on 127.0.0.1 for users who prefer a page to the command line
//! (`coflash ui`).
//!
//! One thread owns the bus (`worker`) and runs one task at a time. The pages get one common state
//! (`state`) by server-sent events (`events`) and send requests (`http`). A request must contain
//! the token of the URL (`guard`). The page itself (`page/`) is plain HTML, CSS and JavaScript and
//! part of the program; it needs neither a build step nor a network.
//!
//! | module | what it does |
//! |---|---|
//! | `server` | connections, and their limits |
//! | `guests` | which connection gives way when there are too many |
//! | `guard` | who may ask |
//! | `http` | what is answered to which request |
//! | `upload` | the body of a file, with its limits |
//! | `events` | the stream of events to a page |
//! | `state` | what all pages show |
//! | `shared` | what server and bus thread share |
//! | `worker` | the thread that owns the bus |
//! | `job` | what can be done |
//! | `work` | how it is done, by `coflash-core` |
//! | `service` | another page: for people who update machines |
//! | `firmware` | the file that was dropped on the page |
//! | `frames` | what goes over the bus, in words, counted, and as a log |
//! | `load` | how long a frame keeps the bus busy |
//! | `adapters` | what this machine has |
//! | `advice` | what to do next, in the words of the page |
#![forbid(unsafe_code)]

mod adapters;
mod advice;
mod events;
mod firmware;
mod frames;
mod guard;
mod guests;
mod http;
mod job;
mod load;
mod server;
mod service;
mod shared;
mod state;
mod upload;
mod work;
mod worker;

pub use self::server::{Options, Server};
pub use self::service::{Origin, Service};
pub use self::shared::Failed;

/// The example on the crate's page compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
