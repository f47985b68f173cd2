//! Opens and lists devices.

use super::driver::GsUsb;
use super::usb;
use super::which::{Choice, Which};
use crate::adapter::{AdapterError, Obstacle};
use crate::driven::Driven;
use crate::found::{shown, Found, Kind, Missing, State};

/// Checks what names a device. It tells its bit rates when it is open.
pub(crate) fn check(which: &str, _: Option<u32>) -> Result<(), &'static str> {
    Which::parse(which).map(|_| ()).ok_or(NO_DEVICE)
}

/// What is wrong with a text that names no device.
const NO_DEVICE: &str = "it names no device by place or serial number: gs_usb:0@500k";

/// Opens a device at a bit rate in bit/s.
pub(crate) fn open(which: &str, rate: u32) -> Result<Driven, AdapterError> {
    let Some(which) = Which::parse(which) else {
        return Err(AdapterError::unusable(
            "gs_usb adapter",
            Obstacle::Other,
            NO_DEVICE,
            "choose another one",
        ));
    };
    let name = format!("gs_usb adapter {which}");
    let adapter = name.clone();
    Driven::open(name, move || {
        let usb = usb::open(&adapter, &which.device)?;
        GsUsb::start(usb, which.channel, rate).map_err(|what| {
            let advice = "unplug the adapter, plug it in and try again; it must speak gs_usb (candleLight)";
            AdapterError::unusable(adapter, Obstacle::Other, what, advice)
        })
    })
}

/// The connected devices, or the system's error.
pub(crate) fn list() -> Result<Vec<Found>, Missing> {
    let devices = usb::list().map_err(|what| Missing {
        what: format!("the USB devices cannot be listed: {what}"),
        advice: "check that this computer has USB",
    })?;
    let found = devices.iter().enumerate().map(|(place, device)| {
        let serial = device
            .serial
            .as_deref()
            .filter(|serial| matches!(Which::parse(serial), Some(Which { device: Choice::Serial(_), .. })));
        let which = serial.map_or_else(|| place.to_string(), str::to_string);
        let about = shown(device.product.as_deref().unwrap_or("USB adapter").as_bytes());
        let found = Found::new(Kind::GsUsb, format!("gs_usb:{}", shown(which.as_bytes())), about);
        match device.kernel {
            true => Found { state: Some(State::Kernel), certain: false, ..found },
            false => found,
        }
    });
    Ok(found.collect())
}
