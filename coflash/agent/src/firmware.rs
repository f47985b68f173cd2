//! The artifact as a program.

use std::path::Path;
use std::sync::Arc;

use super::config::Device;
use coflash_core::file::convert::{program_of, Options, Region};
use coflash_core::file::judge::judge;
use coflash_core::file::ram_image::Fault;
use coflash_core::file::sealed::SealedFile;
use coflash_core::file::{self, AddressRange, Format};
use coflash_core::update::{NewBootloader, Payload};

/// Reads and judges a firmware file, as `coflash flash` does, without the device.
///
/// # Errors
/// The lines for the server: what is wrong, and what to do.
pub(super) fn program(bytes: &[u8], name: &str, device: &Device) -> Result<Payload, Vec<String>> {
    let lines = |what: String, advice: &str| vec![what, format!("what to do: {advice}")];
    let anew = "deploy the firmware file itself: Intel HEX, S-record, ELF, block file or sealed image";
    let format = Format::of(Path::new(name), bytes);
    let bootloader = NewBootloader::in_file(bytes, format);
    if let Some(new) = bootloader.map_err(|fault| lines(format!("{name}: {fault}"), Fault::ADVICE))? {
        return Ok(new.into());
    }
    if format == Some(Format::Sealed) {
        let file = SealedFile::for_program(bytes.to_vec(), device.program);
        let file =
            file.map_err(|refusal| lines(format!("{name}: {refusal}"), &refusal.advice().to_string()))?;
        return Ok(Arc::new(file).into());
    }
    let region: Option<AddressRange> =
        device.board.and_then(|board| board.program(device.program)).map(Into::into);
    let place = region.map(|region| region.first);
    if format == Some(Format::Raw) && place.is_none() {
        let advice = "set board in the agent's configuration";
        return Err(lines(format!("{name}: a raw binary does not contain its address"), advice));
    }
    let firmware =
        file::read(bytes, format, place).map_err(|error| lines(error.of(name).to_string(), anew))?;
    let options = Options::default().region(region.map_or(Region::Unknown, Region::Strict));
    let converted = program_of(firmware, &options);
    let program = converted.map_err(|error| lines(format!("{name}: {error}"), anew))?.program;
    judge(program.image(), program.start(), device.board)
        .map_err(|fault| lines(format!("{name}: {fault}"), &fault.advice().to_string()))?;
    Ok(Arc::new(program).into())
}
