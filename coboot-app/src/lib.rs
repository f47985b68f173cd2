//! What an application needs to run under the coboot bootloader, with any CANopen stack and any
//! executor.
//!
//! | module | what it is |
//! |---|---|
//! | [`start`] | how the program came up: node-ID, bit rate, serial number (the handoff) |
//! | [`program_control`] | objects 1F51h, 1F56h and 1F57h: what to answer and what to do |
//! | [`departure`] | the way back to the bootloader: when the device may leave |
//! | [`bootloader`] | the services of the bootloader underneath, and the reset itself |
//! | [`callgate`] | how these services are called: finds the callgate's table and enters it |
//! | [`bxcan`] | the receive FIFO of bxCAN: frames with every data length code |
//! | [`label!`](label!) | whom the image is for, at its place in the image |
//! | [`layout!`](layout!) | the memory map of the board, as the build script has written it |
//! | `responder` | a small SDO server for applications without a CANopen stack (feature `responder`) |
//!
//! This crate does not wait, allocate or read a clock. The caller passes in the time, as the value
//! of a 32-bit counter of milliseconds, which may wrap.
//!
//! In the order of use:
//!
//! 1. the build script calls `coboot_linker::Application::…::emit()`;
//! 2. [`label!`](label!) says whom the image is for;
//! 3. [`Start::read`] gives node-ID and bit rate before CAN is set up;
//! 4. [`ProgramControl`] answers 1F51h, 1F56h and 1F57h;
//! 5. [`ProgramControl::proceed`] is asked regularly, and after every frame, and says when to leave;
//! 6. `Bootloader::leave` leaves.
#![no_std]

mod abort;
pub mod bootloader;
pub mod callgate;
pub mod departure;
pub mod label;
pub mod program_control;
#[cfg(feature = "responder")]
pub mod responder;
pub mod rules;
pub mod start;

pub use abort::Abort;
pub use bootloader::{Bootloader, Confirmed, Exit, ReentryPath, Services};
pub use departure::Next;
pub use program_control::{ProgramControl, Reply};
pub use start::{Defaults, Start};

pub use shared_abi::bit_timing::BitTiming;
pub use shared_abi::{bxcan, geometry, handoff, layout, nameplate, renewal, warm_start};

/// The memory map of the board as the build script has written it
/// (`coboot_linker::Application::emit`), for a `static` of the program:
///
/// ```ignore
/// static LAYOUT: Layout = coboot_app::layout!();
/// ```
#[macro_export]
macro_rules! layout {
    () => {
        include!(concat!(env!("OUT_DIR"), "/coboot_layout.rs"))
    };
}
