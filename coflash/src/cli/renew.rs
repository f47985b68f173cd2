//! `coflash flash` with a bootloader: renews the bootloaders of devices.

use std::path::Path;
use std::sync::Arc;

use canopen::NodeId;
use coflash::bus::Link;
use coflash::file::ram_image::{RamImage, Version};
use coflash::file::read::{self, Firmware, Format};
use coflash::file::sealed::SealedFile;
use coflash::update::{renew, FlashOptions, NewBootloader, Renewal};
use seal::wire::BOOTLOADER;
use serde_json::{json, Value};

use super::context::Context;
use super::device::Patience;
use super::output::Failure;
use super::progress::Progress;
use super::verify::{self, is_sealed};

/// The bootloader in a file; `None` for any other file, also for one that cannot be read: the update of a
/// program says why.
pub(super) fn bootloader_in(path: &Path, format: Option<Format>) -> Result<Option<NewBootloader>, Failure> {
    if is_sealed(path) {
        let Ok(file) = SealedFile::parse(verify::read(path)?.image) else { return Ok(None) };
        let is_bootloader = file.head().program() == BOOTLOADER;
        return Ok(is_bootloader.then(|| NewBootloader::Sealed(Arc::new(file))));
    }
    let Ok((firmware, _)) = read::load_telling(path, format, Some(0)) else { return Ok(None) };
    let image = match firmware {
        Firmware::Image(image) => image,
        Firmware::Blocks(file) => file.image(),
    };
    let Some(image) = RamImage::find(&image) else { return Ok(None) };
    image.check().map_err(|fault| Failure::file(path, &format!("it {fault}")))?;
    Ok(Some(NewBootloader::Plain(Arc::new(image))))
}

/// Renews the bootloaders of these devices: the first one until it has installed the new bootloader, then
/// the others, one after the other. If the first one fails, the others are not touched.
pub(super) fn renew_all(
    context: &Context,
    link: &mut Link,
    nodes: &[NodeId],
    new: &NewBootloader,
    patience: &Patience,
    options: &FlashOptions,
) -> Result<(), Failure> {
    let version = new.version();
    let mut done: Vec<(NodeId, Renewal)> = Vec::new();
    let mut failed = None;
    for (number, node) in nodes.iter().enumerate() {
        match renew_one(context, link, *node, new, patience, options) {
            Ok(renewal) => done.push((*node, renewal)),
            Err(failure) if nodes.len() == 1 => return Err(failure),
            Err(failure) if number == 0 => {
                context.out.say(format_args!("the first device has failed: the others are not touched"));
                return Err(failure);
            }
            Err(failure) => {
                context.out.say(format_args!("node {node}: {failure}"));
                failed = failed.or(Some(failure));
            }
        }
    }
    let words = words(&done, version);
    context
        .out
        .result(words, || json!({ "command": "flash", "bootloader": version.0, "devices": devices(&done) }));
    failed.map_or(Ok(()), Err)
}

fn renew_one(
    context: &Context,
    link: &mut Link,
    node: NodeId,
    new: &NewBootloader,
    patience: &Patience,
    options: &FlashOptions,
) -> Result<Renewal, Failure> {
    let mut session = patience.session(link, node)?;
    let mut progress = Progress::new(context.out, node);
    let result = renew(&mut session, new, options, &mut |event| progress.show(event));
    progress.finish();
    result.map_err(|error| Failure::diagnosed(error, &mut session))
}

fn words(done: &[(NodeId, Renewal)], version: Version) -> String {
    match done {
        [(_, renewal)] => renewal.to_string(),
        many => format!("{} devices have bootloader {version}", many.len()),
    }
}

fn devices(done: &[(NodeId, Renewal)]) -> Vec<Value> {
    let device = |(node, renewal): &(NodeId, Renewal)| {
        let mut value = json!(renewal);
        value["node"] = node.get().into();
        value
    };
    done.iter().map(device).collect()
}
