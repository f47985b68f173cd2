//! Describes a sealed image in words. Nothing is checked here.

use std::fmt;

use seal::wire::{flag, role, tag, Certificate, RESERVED};
use shared_abi::block_file::ProgramVersion;

use super::key::PublicKey;
use super::open::Sealed;
use crate::file::inspect::Date;

/// The flags of a manifest, each with its name.
pub const FLAGS: [(u8, &str); 6] = [
    (flag::ENCRYPTED, "encrypted"),
    (flag::COMPRESSED, "compressed"),
    (flag::DICTIONARY, "other program is the dictionary"),
    (flag::DATA, "data"),
    (flag::WRITES_FLASH, "application writes flash"),
    (flag::TEST, "for tests"),
];

/// The names of the flags that are set.
pub fn flags(flags: u8) -> impl Iterator<Item = &'static str> {
    FLAGS.into_iter().filter(move |(flag, _)| flags & flag != 0).map(|(_, name)| name)
}

/// Bytes as hexadecimal digits.
#[must_use]
pub fn digits(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The text of a record, without trailing zeros and control characters.
#[must_use]
pub fn text(bytes: &[u8]) -> String {
    let text = String::from_utf8_lossy(bytes);
    text.trim_end_matches('\0').chars().map(|c| if c.is_control() { '?' } else { c }).collect()
}

/// The name of a role.
#[must_use]
pub fn role_name(role: u8) -> &'static str {
    match role {
        role::RELEASE => "release",
        role::TEST => "test",
        role::BOOTLOADER => "bootloader",
        _ => "unknown",
    }
}

/// A certificate as text.
#[derive(Clone, Copy, Debug)]
pub struct CertificateWords<'a>(pub Certificate<'a>);

impl fmt::Display for CertificateWords<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(certificate) = self;
        let (lowest, highest) = (certificate.lowest(), certificate.highest());
        write!(f, "{} key ", role_name(certificate.role()))?;
        match PublicKey::new(certificate.key()) {
            Ok(key) => write!(f, "{:08X}h", key.id())?,
            Err(_) => write!(f, "that is invalid")?,
        }
        write!(f, " of root {:08X}h, epoch {}", certificate.root_id(), certificate.epoch())?;
        write!(f, ", vendor-ID {:08X}h", certificate.vendor_id())?;
        match certificate.product_code() {
            0 => write!(f, ", all products")?,
            code => write!(f, ", product code {code:08X}h")?,
        }
        write!(f, ", security counters {lowest} to {highest}")?;
        if certificate.reserved() != [0; RESERVED] {
            write!(f, ", of a later format (its reserved bytes are not 0): this coflash does not use it")?;
        }
        Ok(())
    }
}

impl fmt::Display for Sealed<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let head = self.head;
        let (size, payload) = (head.size(), head.payload());
        let is_data = head.flags() & flag::DATA != 0;
        writeln!(f, "sealed image, well-formed")?;
        writeln!(
            f,
            "  for          vendor-ID {:08X}h, product code {:08X}h",
            head.vendor_id(),
            head.product_code()
        )?;
        writeln!(f, "  program      {}{}", head.program(), if is_data { " (data)" } else { "" })?;
        match head.created() {
            0 => writeln!(f, "  version      {}", ProgramVersion(head.version()))?,
            date => writeln!(f, "  version      {} of {}", ProgramVersion(head.version()), Date(date))?,
        }
        writeln!(f, "  counter      {}", head.counter())?;
        writeln!(f, "  image        {size} bytes, CRC {:08X}h", head.crc())?;
        writeln!(f, "  payload      {payload} bytes in chunks of {}", 1_u32 << (head.chunk() & 31))?;
        let names: Vec<&str> = flags(head.flags()).collect();
        writeln!(
            f,
            "  flags        {}",
            if names.is_empty() { "none".to_string() } else { names.join(", ") }
        )?;
        if head.unique_id() != [0; 12] {
            writeln!(f, "  only for     the device with the unique ID {}", digits(&head.unique_id()))?;
        }
        if head.hardware() != 0 {
            let revisions: Vec<String> =
                (0..32).filter(|bit| head.hardware() >> bit & 1 == 1).map(|bit| bit.to_string()).collect();
            writeln!(f, "  hardware     revisions {} (low 5 bits of 1018h/3)", revisions.join(", "))?;
        }
        for recipient in self.recipients() {
            writeln!(f, "  opened by    key-encryption key {:08X}h", recipient.key_id())?;
        }
        for (tag, bytes) in head.records() {
            match tag {
                tag::RECIPIENT => {}
                tag::TEXT => writeln!(f, "  text         {}", text(bytes))?,
                tag::SOURCE => writeln!(f, "  source       {}", text(bytes))?,
                tag::SBOM => writeln!(f, "  SBOM         SHA-512/256 {}", digits(bytes))?,
                tag => writeln!(f, "  record       {tag:04X}h, {} bytes", bytes.len())?,
            }
        }
        match head.certificate() {
            Some(certificate) => writeln!(f, "  certificate  {}", CertificateWords(certificate))?,
            None => writeln!(f, "  certificate  none: signed by a root itself")?,
        }
        for id in self.signers() {
            writeln!(f, "  signature    of the key {id:08X}h")?;
        }
        writeln!(f, "  image hash   {}", digits(head.image_hash()))?;
        if head.dictionary() != [0; 32] {
            writeln!(f, "  dictionary   {}", digits(head.dictionary()))?;
        }
        writeln!(f, "  chain        {}", digits(&head.chain()))
    }
}
