//! Adapters that speak gs_usb (candleLight, CANable, CANtact and others) without a kernel driver:
//! `gs_usb:0@500k`, or by serial number; `gs_usb:0/1@500k` for the second channel.
//!
//! The protocol ([`wire`]) knows no USB, and USB ([`usb`], by the crate `nusb`) no protocol. Not tried
//! on hardware: tested against a stand-in for USB.

mod driver;
mod open;
mod usb;
mod which;
mod wire;

pub(super) use self::open::{list, open};
pub(super) use self::which::Which;
