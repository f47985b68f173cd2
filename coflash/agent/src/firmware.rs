//! The artifact as what its target gets.

use std::path::Path;

use super::config::{Device, Machine, Target, TargetKind};
use coflash_core::file::ram_image;
use coflash_core::machine::{is_package, Fault, Package, SignatureFault};
use coflash_core::update::{ContentFault, Payload, Reading};

/// What a target gets: read, checked and judged.
#[derive(Debug)]
pub enum Content<'t> {
    /// A program for a device.
    Program(&'t Device, Payload),
    /// A package for a machine.
    Package(&'t Machine, Box<Package>),
}

/// Reads and judges a file, as `coflash flash` does, without any device.
///
/// # Errors
/// The lines for the server: what is wrong, and what to do.
pub(super) fn content<'t>(bytes: &[u8], name: &str, target: &'t Target) -> Result<Content<'t>, Vec<String>> {
    match &target.what {
        TargetKind::Machine(machine) => {
            package(bytes, name, machine).map(|package| Content::Package(machine, Box::new(package)))
        }
        TargetKind::Device(_) if is_package(Path::new(name), bytes) => Err(lines(
            format!("{name} is a package for a machine, and this target is one device"),
            "deploy the program of this device alone, or give the package to a target that the agent's \
             configuration names as a [[machine]]",
        )),
        TargetKind::Device(device) => {
            program(bytes, name, device).map(|program| Content::Program(device, program))
        }
    }
}

/// What is wrong, and what to do.
fn lines(what: String, advice: &str) -> Vec<String> {
    vec![what, format!("what to do: {advice}")]
}

/// A package that is whole, and signed by those whom the machine trusts.
fn package(bytes: &[u8], name: &str, machine: &Machine) -> Result<Package, Vec<String>> {
    let refused = |fault: Fault| {
        let advice = match &fault {
            Fault::Signature(SignatureFault::None) => {
                "deploy it with a signature (coflash package --key): an agent takes no other"
            }
            Fault::Signature(SignatureFault::Stranger { .. }) => {
                "do not deploy it unless you know this key; trust in the agent's configuration names the roots"
            }
            fault => fault.advice(),
        };
        lines(format!("{name} {fault} [{:#010X}]", fault.number()), advice)
    };
    let package = Package::parse(bytes).map_err(refused)?;
    package.trust(&machine.trust).map_err(refused)?;
    Ok(package)
}

fn program(bytes: &[u8], name: &str, device: &Device) -> Result<Payload, Vec<String>> {
    let reading = Reading::new(device.program).board(device.board);
    let loaded = reading.read(Path::new(name), bytes).map_err(|fault| {
        let anew = "deploy the firmware file itself: Intel HEX, S-record, ELF, block file or sealed image";
        match fault {
            ContentFault::Bootloader(fault) => lines(format!("{name}: {fault}"), ram_image::Fault::ADVICE),
            ContentFault::Sealed(refusal) => {
                lines(format!("{name}: {refusal}"), &refusal.advice().to_string())
            }
            ContentFault::Judged(fault) => lines(format!("{name}: {fault}"), &fault.advice().to_string()),
            fault if fault.is_without_address() => lines(
                format!("{name}: a raw binary does not contain its address"),
                "set board in the agent's configuration",
            ),
            ContentFault::File(error) => lines(error.of(name).to_string(), anew),
            fault => lines(format!("{name}: {fault}"), anew),
        }
    })?;
    Ok(loaded.payload)
}
