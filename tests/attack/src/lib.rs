//! Random actions against a device, and the rules that it keeps whatever comes.
//!
//! | module | what it has |
//! |---|---|
//! | `device` | what can be done to a device, and what is found of it |
//! | `files` | what can be sent |
//! | `script` | the actions of a seed |
//! | `rules` | what must be true after each action |
//! | `play` | carries them out, and shortens those that break a rule |
//! | `cuts` | cuts the power in each flash operation of a list of actions, and of the recovery |
//! | `model` | the bootloader on the model of a flash |
//! | `mistakes` | the same with a seeded mistake, which the rules must find |
//! | `sealed` | keys, and sealed images that can be changed |
//!
//! The same seed gives the same actions, and a fuzzer's bytes are a seed, too. A seed that breaks a
//! rule is shortened and printed. Another device is another [`Device`](device::Device); another
//! rule is one more line of [`RULES`](rules::RULES).

#![allow(missing_docs, reason = "names say it")]
#![forbid(unsafe_code)]

pub mod cuts;
pub mod device;
pub mod files;
pub mod mistakes;
pub mod model;
pub mod play;
pub mod rules;
pub mod script;
pub mod sealed;
