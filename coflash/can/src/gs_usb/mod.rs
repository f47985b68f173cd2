//! Adapters that speak gs_usb (candleLight, CANable, CANtact and others) without a kernel driver.
//! The URL names the device by its place, `gs_usb:0@500k`, or by its serial number;
//! `gs_usb:0/1@500k` is its second channel.
//!
//! The protocol ([`wire`]) knows nothing of USB, and the USB access ([`usb`], with the crate
//! `nusb`) knows nothing of the protocol. Tested against a stand-in for USB, not on hardware.

mod driver;
mod open;
mod usb;
mod which;
mod wire;

pub(super) use self::open::{check, list, open};
