//! The artifact as a program.

use std::path::Path;

use super::config::Device;
use coflash_core::file::ram_image::Fault;
use coflash_core::update::{ContentFault, Payload, Reading};

/// Reads and judges a firmware file, as `coflash flash` does, without the device.
///
/// # Errors
/// The lines for the server: what is wrong, and what to do.
pub(super) fn program(bytes: &[u8], name: &str, device: &Device) -> Result<Payload, Vec<String>> {
    let reading = Reading::new(device.program).board(device.board);
    let loaded = reading.read(Path::new(name), bytes).map_err(|fault| {
        let anew = "deploy the firmware file itself: Intel HEX, S-record, ELF, block file or sealed image";
        let (what, advice) = match fault {
            ContentFault::Bootloader(fault) => (format!("{name}: {fault}"), Fault::ADVICE),
            ContentFault::Sealed(refusal) => (format!("{name}: {refusal}"), refusal.advice()),
            ContentFault::Judged(fault) => (format!("{name}: {fault}"), fault.advice()),
            fault if fault.is_without_address() => (
                format!("{name}: a raw binary does not contain its address"),
                "set board in the agent's configuration",
            ),
            ContentFault::File(error) => (error.of(name).to_string(), anew),
            fault => (format!("{name}: {fault}"), anew),
        };
        vec![what, format!("what to do: {advice}")]
    })?;
    Ok(loaded.payload)
}
