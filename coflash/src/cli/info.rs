//! `coflash info`: what a device says about itself.

use canopen::program::FlashStatus;
use clap::Args;
use coflash::device::info::{info, DeviceInfo};
use coflash::device::Dialect;
use serde_json::{json, Value};

use super::context::Context;
use super::device::Device;
use super::output::Failure;

/// Shows what runs on a device, its identity, and the state of its programs.
#[derive(Debug, Args)]
pub(super) struct Info {
    #[command(flatten)]
    device: Device,
}

impl Info {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        let mut link = context.link()?;
        let mut session = self.device.session(&mut link)?;
        let info = info(&mut session).map_err(|error| Failure::diagnosed(error, &mut session))?;
        context.out.result(&info, || value(&info));
        Ok(())
    }
}

/// For programs.
pub(super) fn value(info: &DeviceInfo) -> Value {
    let [vendor_id, product_code, revision, serial_number] = info.identity;
    let programs: Vec<Value> = info
        .programs
        .iter()
        .map(|program| {
            json!({
                "number": program.number,
                "control": program.control,
                "crc": program.crc,
                "status": program.status.map(status),
            })
        })
        .collect();
    json!({
        "command": "info",
        "node": info.node.get(),
        "device_type": info.device_type.0,
        "bootloader": info.device_type.is_bootloader(),
        "error_register": info.error_register,
        "name": info.name,
        "hardware_version": info.hardware_version,
        "software_version": info.software_version,
        "vendor_id": vendor_id,
        "product_code": product_code,
        "revision": revision,
        "serial_number": serial_number,
        "dialect": info.dialect.map(Dialect::name),
        "programs": programs,
    })
}

/// 1F57h for programs.
pub(super) fn status(status: FlashStatus) -> Value {
    json!({
        "word": status.to_word(),
        "busy": status.busy,
        "error": status.error.map(|error| error.code()),
        "error_text": status.error.map(|error| error.to_string()),
        "detail": status.detail,
    })
}
