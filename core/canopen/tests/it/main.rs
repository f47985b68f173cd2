//! The tests of the crate from outside: everything that it can do, with all its features.

mod block;
mod client;
mod contention;
mod debugger;
mod emcy;
mod group;
mod line;
mod lss;
mod node;
mod pdo;
mod properties;
mod second_server;
mod server;
mod slave;
mod stalled_host;
mod values;
mod wire;
