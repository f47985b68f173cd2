//! Whether a device may accept an image, by all rules except the signatures: to check a signature
//! takes a device a tenth of a second, and these rules take almost no time.
//!
//! The order of the questions: Is it a sealed image? Is it for this device? Is it recent enough?
//! Does the device have the keys?

use crate::key_block::{self, FOR_TESTS, KEKS, KEK_COUNT, ROOTS, ROOT_COUNT};
use crate::wire::{
    flag, role, tag, word, Fault, Head, Requirements, BOOTLOADER, CERTIFICATE, ED25519, FIXED, FORMAT,
    MAX_CHUNK, MIN_CHUNK, RECIPIENT, RESERVED,
};

/// The device that has received the image.
#[derive(Clone, Copy, Debug)]
pub struct Device<'a> {
    /// 1018h/1.
    pub vendor_id: u32,
    /// 1018h/2.
    pub product_code: u32,
    /// 1018h/3.
    pub revision: u32,
    /// The 96-bit unique ID of the chip.
    pub unique_id: [u8; 12],
    /// The program to be written: the sub-index of 1F50h, or [`BOOTLOADER`].
    pub program: u8,
    /// What the device has for a RAM image of its bootloader; `None` if that cannot be renewed.
    pub has: Option<Requirements>,
    /// Whether this program number is for data of the application.
    pub is_data: bool,
    /// Bytes of the program's flash.
    pub room: u32,
    /// The lowest security counter that the device accepts.
    pub counter: u32,
    /// The lowest epoch of a certificate that the device accepts.
    pub epoch: u32,
    /// Its [`key_block`].
    pub keys: &'a [u8],
}

/// The keys for an accepted image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Needs {
    /// The root that must have signed the certificate, or the image if there is no certificate: its
    /// offset in the key block.
    pub root: usize,
    /// The device's epoch after the installation.
    pub epoch: u32,
    /// For an encrypted image: the offset of the key-encryption key in the key block, and the
    /// offset of the recipient's record in the manifest.
    pub recipient: Option<(usize, usize)>,
}

/// Checks the head of an image.
///
/// # Errors
/// The reason why the device refuses it.
pub fn judge(head: Head<'_>, device: &Device<'_>) -> Result<Needs, Fault> {
    let flags = head.flags();
    let chunk = head.chunk();
    let size = head.size();
    let has = |which: u8| flags & which != 0;
    let possible = flags & !flag::KNOWN == 0
        && (MIN_CHUNK..=MAX_CHUNK).contains(&chunk)
        && head.format() <= FORMAT
        && size > 0
        && head.payload() > 0
        && (has(flag::COMPRESSED) || head.payload() == size)
        && (has(flag::COMPRESSED) || !has(flag::DICTIONARY));
    if !possible {
        return Err(Fault::Format);
    }
    let is_bootloader = device.program == BOOTLOADER;
    let mut needs = None;
    let mut recipient = None;
    let mut at = FIXED;
    for (tag, record) in head.records() {
        at += 4;
        if tag == tag::RECIPIENT && record.len() == RECIPIENT {
            let key = key_block::find(device.keys, KEKS, KEK_COUNT, word(record, 0));
            recipient = recipient.or(key.map(|key| (key, at)));
        } else if tag == tag::BOOTLOADER && is_bootloader && needs.is_none() {
            needs = Requirements::parse(record);
        } else if tag & tag::CRITICAL != 0 {
            return Err(Fault::Format);
        }
        at += record.len();
    }
    if head.vendor_id() != device.vendor_id {
        return Err(Fault::WrongVendor);
    }
    let unique_id = head.unique_id();
    let hardware = head.hardware();
    let fits = head.product_code() == device.product_code
        && head.program() == device.program
        && has(flag::DATA) == device.is_data
        && (unique_id == [0; 12] || unique_id == device.unique_id)
        && (hardware == 0 || hardware >> (device.revision & 31) & 1 == 1);
    if !fits {
        return Err(Fault::WrongProduct);
    }
    // A program that writes flash could write a bootloader that nobody has verified.
    let writes = has(flag::WRITES_FLASH) && device.has.is_some();
    let holds = match (needs, device.has) {
        _ if !is_bootloader => !writes,
        (Some(needs), Some(has_it)) => {
            needs.board == has_it.board
                && needs.services <= has_it.services
                && needs.features == has_it.features
                && !writes
                && !has(flag::DICTIONARY)
        }
        _ => false,
    };
    if !holds {
        return Err(Fault::WrongProduct);
    }
    if size > device.room {
        return Err(Fault::Address);
    }
    let counter = head.counter();
    if counter < device.counter {
        return Err(Fault::Rollback);
    }
    judge_signer(head, device, flags, counter, recipient)
}

/// Checks the certificate of an image with these flags and this security counter, and that the device has the keys.
/// `recipient` is that of [`Needs`].
fn judge_signer(
    head: Head<'_>,
    device: &Device<'_>,
    flags: u8,
    counter: u32,
    recipient: Option<(usize, usize)>,
) -> Result<Needs, Fault> {
    let has = |which: u8| flags & which != 0;
    let for_tests = word(device.keys, key_block::FLAGS) & FOR_TESTS != 0;
    let mut epoch = device.epoch;
    let mut test = has(flag::TEST);
    let mut root_id = 0;
    if let Some(certificate) = head.certificate() {
        test |= certificate.role() == role::TEST;
        let own = certificate.product_code();
        let holds = usize::from(certificate.size()) == CERTIFICATE
            && u16::from(certificate.algorithm()) == ED25519
            && may_sign(certificate.role(), device.program == BOOTLOADER)
            && certificate.vendor_id() == device.vendor_id
            && (own == 0 || own == device.product_code)
            && (certificate.lowest()..=certificate.highest()).contains(&counter)
            && certificate.reserved() == [0; RESERVED];
        if !holds {
            return Err(Fault::Signature);
        }
        if certificate.epoch() < epoch {
            return Err(Fault::Rollback);
        }
        epoch = certificate.epoch();
        root_id = certificate.root_id();
    }
    let mut root = key_block::find(device.keys, ROOTS, ROOT_COUNT, root_id);
    if head.certificate().is_none() {
        // A root may sign a program directly.
        root = (ROOTS..KEKS).step_by(key_block::KEY).find(|at| {
            let id = word(device.keys, *at);
            id != 0 && head.signature(id).is_some()
        });
    }
    let Some(root) = root else { return Err(Fault::Key) };
    if test && !for_tests || has(flag::ENCRYPTED) && recipient.is_none() {
        return Err(Fault::Key);
    }
    let recipient = recipient.filter(|_| has(flag::ENCRYPTED));
    Ok(Needs { root, epoch, recipient })
}

/// Whether a key with this role signs bootloaders, or programs.
const fn may_sign(of: u8, bootloaders: bool) -> bool {
    if bootloaders {
        of == role::BOOTLOADER
    } else {
        of == role::RELEASE || of == role::TEST
    }
}
