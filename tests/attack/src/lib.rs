//! Random actions against a device, and the rules that it keeps whatever comes.
//!
//! | module | what it has |
//! |---|---|
//! | `device` | what can be done to a device, and what is found of it |
//! | `files` | what can be sent |
//! | `script` | the actions of a seed |
//! | `rules` | what must be true after each action |
//! | `play` | carries them out, and shortens those that break a rule |
//! | `model` | the first device: the bootloader on the model of a flash |
//!
//! The same seed gives the same actions. A seed that breaks a rule is shortened and printed. Another device
//! (an emulated board, a node without a chip) is another [`Device`](device::Device); another rule is one more line
//! of [`RULES`](rules::RULES).

#![allow(missing_docs, reason = "names say it")]
#![forbid(unsafe_code)]

pub mod device;
pub mod files;
pub mod model;
pub mod play;
pub mod rules;
pub mod script;
