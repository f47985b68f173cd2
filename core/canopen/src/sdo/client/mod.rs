//! The SDO client: one value per transfer, [`Download`] or [`Upload`].
//!
//! A transfer is driven through [`Transfer`]: [`handle`](Transfer::handle) processes any received
//! frame, and [`poll`](Transfer::poll) returns the next action. A blocking caller loops over one
//! transfer; a caller with many nodes keeps one transfer for each node and passes every frame to
//! all of them.
//!
//! ```
//! use canopen::sdo::client::{Buffer, Config, Step, Transfer, Upload};
//! use canopen::{Address, Frame, Instant, NodeId};
//!
//! # fn send(_: &Frame) {}
//! # fn receive(_until: Instant) -> Option<Frame> { None }
//! # let mut clock = (0..).step_by(100).map(Instant::from_millis);
//! # let mut now = || clock.next().unwrap();
//! let node = NodeId::new(5).unwrap();
//! let mut bytes = [0; 4];
//! let vendor_id = Buffer::new(&mut bytes);
//! let mut upload = Upload::new(node, Address::new(0x1018, 1), vendor_id, Config::default());
//! let result = loop {
//!     match upload.poll(now()) {
//!         Step::Send(frame) => send(&frame),
//!         Step::Wait(until) => {
//!             if let Some(frame) = receive(until) {
//!                 upload.handle(&frame, now());
//!             }
//!         }
//!         Step::Done(result) => break result,
//!     }
//! };
//! let vendor_id = upload.into_sink();
//! let bytes = vendor_id.filled();
//! # assert_eq!(result, Err(canopen::sdo::SdoError::NoAnswer));
//! ```
//!
//! A block transfer sends or receives many frames between two answers. Between two [`Step::Send`] a
//! caller should process the frames that have arrived, so that an abort in the middle ends the
//! transfer at once.

mod download;
mod group;
mod transfer;
mod upload;

pub use download::Download;
pub use group::{GroupDownload, GroupResult, GroupStep, Servers, SERVERS_MAX};
pub use transfer::{Block, Config, SdoError, Step, Transfer};
pub use upload::{Buffer, Sink, Upload};
