//! The update procedure against fake devices, in virtual time.

mod admission;
mod aftermath;
mod dialects;
mod events;
mod many;
mod master;
mod mastership;
mod procedure;
pub mod renew;
mod search;
mod watch;
