//! Parses a sealed image and checks it as a device does: head, identity, counter, keys, signatures,
//! chain, and then the image itself.
//!
//! A device has one error number for several of these rules; here each rule has its own message.

use seal::judge::judge;
use seal::wire::{
    array, flag, head_size, role, tag, word, Certificate, Fault, Head, Recipient, Requirements, BOOTLOADER,
    CERTIFICATE, ED25519, FORMAT, HASH, MAGIC, MAX_CHUNK, MIN_CHUNK, RECIPIENT, RESERVED,
};

use super::cipher::{chacha20, hash, wrap};
use super::key::{Kek, PublicKey};
use super::{key_block, lzma};
use crate::advice::Advice;
use crate::file::checksum::CRC;
use crate::file::program::{Target, MAX_PROGRAM_SIZE};

/// A sealed image with the size that its head announces; no other property is checked.
#[derive(Clone, Copy, Debug)]
pub struct Sealed<'a> {
    /// Manifest, certificate and signatures.
    pub head: Head<'a>,
    /// The chunks with their hashes.
    pub chunks: &'a [u8],
}

/// A sealed image in a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SealedFile {
    bytes: Vec<u8>,
    /// The size of the head in bytes.
    head: usize,
}

impl SealedFile {
    /// Accepts a file that [`Sealed::parse`] accepts.
    ///
    /// # Errors
    /// Those of [`Sealed::parse`].
    pub fn parse(bytes: Vec<u8>) -> Result<Self, Refusal> {
        let head = Sealed::parse(&bytes)?.head.0.len();
        Ok(Self { bytes, head })
    }

    /// The same for a file that will be written as this program.
    ///
    /// # Errors
    /// Those of [`Self::parse`], and [`Refusal::Program`].
    pub fn for_program(bytes: Vec<u8>, program: u8) -> Result<Self, Refusal> {
        let file = Self::parse(bytes)?;
        match file.head().program() {
            image if image != program => Err(Refusal::Program { image, device: program }),
            _ => Ok(file),
        }
    }

    /// All bytes of the file, which are sent to the device.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// The device that it names.
    #[must_use]
    pub fn target(&self) -> Target {
        let head = self.head();
        Target { vendor_id: head.vendor_id(), product_code: head.product_code() }
    }

    /// Manifest, certificate and signatures.
    #[must_use]
    pub fn head(&self) -> Head<'_> {
        self.parts().head
    }

    /// The parts of the image.
    #[must_use]
    pub fn parts(&self) -> Sealed<'_> {
        let (head, chunks) = self.bytes.split_at(self.head);
        Sealed { head: Head(head), chunks }
    }
}

/// The device that an image is checked for. A property that is `None` is assumed to match the
/// image.
#[derive(Clone, Copy, Debug, Default)]
pub struct Device<'a> {
    /// The roots in its key block.
    pub roots: &'a [PublicKey],
    /// Its key-encryption keys; without any, the payload of an encrypted image is not checked.
    pub keks: &'a [Kek],
    /// Its other program as it lies in flash: the dictionary of images that have one.
    pub base: Option<&'a [u8]>,
    /// 1018h/1.
    pub vendor_id: Option<u32>,
    /// 1018h/2.
    pub product_code: Option<u32>,
    /// 1018h/3.
    pub revision: Option<u32>,
    /// The 96-bit unique ID of the chip.
    pub unique_id: Option<[u8; 12]>,
    /// The number of the program to be written.
    pub program: Option<u8>,
    /// The size of the program's flash in bytes.
    pub room: Option<u32>,
    /// The lowest security counter that it accepts.
    pub counter: u32,
    /// The lowest epoch of a certificate that it accepts.
    pub epoch: u32,
    /// Whether it accepts programs signed with a test key.
    pub for_tests: bool,
}

/// An image that the device accepts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Opened {
    /// The image as it lies in flash, if it could be decoded.
    pub image: Option<Vec<u8>>,
    /// The reason if it could not.
    pub closed: Option<Closed>,
    /// The key that signed the image.
    pub signed_by: PublicKey,
    /// The root of the signature.
    pub root: PublicKey,
    /// The device's epoch after the installation.
    pub epoch: u32,
}

/// Why the image of a valid chain was not decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Closed {
    /// It is encrypted, and the user gave no key-encryption key.
    Encrypted,
    /// Its dictionary is the device's other program, which the user did not give.
    Dictionary,
}

/// The rule that an image breaks.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// It is another kind of file.
    #[error("it is not a sealed image: its first bytes are not CBS1")]
    NotSealed,
    /// The head has an impossible size.
    #[error("the head is damaged: the size of its manifest or the number of its signatures is impossible")]
    Head,
    /// The file ends too early.
    #[error("it is cut off: it must have {needed} bytes and has {found}")]
    CutOff {
        /// Announced size in bytes.
        needed: u64,
        /// Actual size in bytes.
        found: u64,
    },
    /// The file is longer than announced.
    #[error("it has {found} bytes and announces {needed}: something was appended to it")]
    TooLong {
        /// Announced size in bytes.
        needed: u64,
        /// Actual size in bytes.
        found: u64,
    },
    /// A field has an impossible value.
    #[error("the manifest is invalid: {0}")]
    Field(&'static str),
    /// It is for devices of another vendor.
    #[error("it is for vendor-ID {image:08X}h, and the device has {device:08X}h")]
    Vendor {
        /// The image's value.
        image: u32,
        /// The device's value.
        device: u32,
    },
    /// It is for another product.
    #[error("it is for product code {image:08X}h, and the device has {device:08X}h")]
    Product {
        /// The image's value.
        image: u32,
        /// The device's value.
        device: u32,
    },
    /// It is for another program number.
    #[error("it is for program {image}, and program {device} is to be written")]
    Program {
        /// The image's value.
        image: u8,
        /// The program to be written.
        device: u8,
    },
    /// It is for a single device.
    #[error("it is only for a device with another unique ID")]
    UniqueId,
    /// It is for other hardware.
    #[error("it is not for hardware revision {device:08X}h (its revisions have the mask {mask:08X}h)")]
    Hardware {
        /// The image's mask of revisions.
        mask: u32,
        /// The device's revision.
        device: u32,
    },
    /// It is too large.
    #[error("the program has {image} bytes, and the device has room for {device}")]
    TooLarge {
        /// Size of the image in bytes.
        image: u32,
        /// Size of the flash in bytes.
        device: u32,
    },
    /// It is an old program.
    #[error("its security counter is {image}, and the device accepts none below {device}")]
    Counter {
        /// The image's value.
        image: u32,
        /// The lowest permitted value.
        device: u32,
    },
    /// Its certificate is old.
    #[error("its certificate has epoch {image}, and the device accepts none below {device}")]
    Epoch {
        /// The certificate's value.
        image: u32,
        /// The lowest permitted value.
        device: u32,
    },
    /// Its certificate does not allow this image.
    #[error("its certificate is not valid: {0}")]
    Certificate(&'static str),
    /// Its root is unknown.
    #[error("its root {0:08X}h is not one of the given roots")]
    Root(u32),
    /// It has no certificate, and no root has signed it.
    #[error("it has no certificate, and none of the given roots has signed it")]
    NoCertificate,
    /// It is signed with a test key.
    #[error("it is signed for tests, and the device is not marked for tests")]
    Test,
    /// No key for its encryption is known.
    #[error("it is encrypted for other keys than the given ones")]
    Kek,
    /// The root has not signed the certificate.
    #[error("the signature of its certificate is wrong: the root {0:08X}h has not signed these bytes")]
    CertificateSignature(u32),
    /// The certified key has not signed the image.
    #[error("it contains the certificate of the key {0:08X}h but no signature of this key")]
    NoSignature(u32),
    /// The signature belongs to another manifest.
    #[error("its signature is wrong: the key {0:08X}h has not signed this manifest")]
    Signature(u32),
    /// A chunk differs from the signed one.
    #[error("chunk {number} of {of} is not the one that was signed")]
    Chain {
        /// Its number, counted from 1.
        number: usize,
        /// The number of chunks.
        of: usize,
    },
    /// The key has the right id and the wrong value.
    #[error("the key-encryption key {0:08X}h does not decrypt it: the check value differs")]
    WrongKek(u32),
    /// The other program differs.
    #[error("its dictionary is not the given program")]
    Dictionary,
    /// The payload is not a compressed image.
    #[error("its payload cannot be decompressed")]
    Compression,
    /// The image differs from the signed one.
    #[error("the image is not the one that was signed: its hash differs")]
    Hash,
    /// The CRC in the manifest is wrong.
    #[error("the CRC of the image is {found:08X}h, and its manifest says {said:08X}h")]
    Crc {
        /// The image's CRC.
        found: u32,
        /// The manifest's CRC.
        said: u32,
    },
}

impl Refusal {
    /// The error that a device with the same keys reports (1F57h).
    #[must_use]
    pub fn fault(&self) -> Fault {
        match self {
            Self::NotSealed | Self::Head | Self::CutOff { .. } | Self::TooLong { .. } | Self::Field(_) => {
                Fault::Format
            }
            Self::Vendor { .. } => Fault::WrongVendor,
            Self::Product { .. } | Self::Program { .. } | Self::UniqueId | Self::Hardware { .. } => {
                Fault::WrongProduct
            }
            Self::TooLarge { .. } => Fault::Address,
            Self::Counter { .. } | Self::Epoch { .. } => Fault::Rollback,
            Self::Root(_) | Self::NoCertificate | Self::Test | Self::Kek | Self::WrongKek(_) => Fault::Key,
            Self::Certificate(_)
            | Self::CertificateSignature(_)
            | Self::NoSignature(_)
            | Self::Signature(_)
            | Self::Chain { .. }
            | Self::Dictionary
            | Self::Compression
            | Self::Hash
            | Self::Crc { .. } => Fault::Signature,
        }
    }

    /// What to do next.
    #[must_use]
    pub const fn advice(&self) -> Advice {
        match self {
            Self::NotSealed => Advice::GiveSealed,
            Self::Head | Self::CutOff { .. } | Self::TooLong { .. } | Self::Chain { .. } => Advice::CopyAgain,
            Self::Field(_) => Advice::SealedByOther,
            Self::Vendor { .. } | Self::Product { .. } | Self::Program { .. } => Advice::SealedForOther,
            Self::UniqueId => Advice::SealedForChip,
            Self::Hardware { .. } => Advice::SealedForRevision,
            Self::TooLarge { .. } => Advice::Smaller,
            Self::Counter { .. } => Advice::HigherCounter,
            Self::Epoch { .. } => Advice::RevokedKey,
            Self::Certificate(_) => Advice::Certify,
            Self::Root(_) | Self::NoCertificate => Advice::GiveRoot,
            Self::Test => Advice::ReleaseKey,
            Self::Kek | Self::WrongKek(_) => Advice::GiveKek,
            Self::CertificateSignature(_) => Advice::UnknownCertificate,
            Self::NoSignature(_) | Self::Signature(_) => Advice::UnknownOrigin,
            Self::Dictionary => Advice::GiveBase,
            Self::Compression | Self::Hash | Self::Crc { .. } => Advice::SealAgain,
        }
    }
}

impl<'a> Sealed<'a> {
    /// Whether these bytes begin like a sealed image.
    #[must_use]
    pub fn looks_like(bytes: &[u8]) -> bool {
        bytes.starts_with(&MAGIC)
    }

    /// Parses a file.
    ///
    /// # Errors
    /// [`Refusal::NotSealed`], [`Refusal::Head`], [`Refusal::Field`], [`Refusal::CutOff`] or
    /// [`Refusal::TooLong`].
    pub fn parse(bytes: &'a [u8]) -> Result<Self, Refusal> {
        if !Self::looks_like(bytes) {
            return Err(Refusal::NotSealed);
        }
        let found = bytes.len() as u64;
        let size = head_size(bytes).map_err(|_| Refusal::Head)?;
        let (Some(head), Some(chunks)) = (bytes.get(..size), bytes.get(size..)) else {
            return Err(Refusal::CutOff { needed: size as u64, found });
        };
        let head = Head(head);
        if !(MIN_CHUNK..=MAX_CHUNK).contains(&head.chunk()) {
            return Err(Refusal::Field("no device accepts chunks of this size"));
        }
        let payload = u64::from(head.payload());
        let needed = size as u64 + payload + HASH as u64 * payload.div_ceil(1 << head.chunk());
        match () {
            () if found < needed => Err(Refusal::CutOff { needed, found }),
            () if found > needed => Err(Refusal::TooLong { needed, found }),
            () => Ok(Self { head, chunks }),
        }
    }

    /// The recipients of the encryption, with the ids of their keys.
    pub fn recipients(&self) -> impl Iterator<Item = Recipient<'a>> + 'a {
        let records = self.head.records().filter(|(tag, _)| *tag == tag::RECIPIENT);
        records.filter_map(|(_, record)| <&[u8; RECIPIENT]>::try_from(record).ok().map(Recipient))
    }

    /// The ids of the keys that have signed it.
    #[must_use]
    pub fn signers(&self) -> Vec<u32> {
        let mut at = self.head.manifest().len() + self.head.certificate().map_or(0, |_| CERTIFICATE);
        let mut ids = Vec::new();
        for _ in 0..self.head.signatures() {
            ids.push(word(self.head.0, at));
            at += seal::wire::SIGNATURE_HEADER + usize::from(seal::wire::half(self.head.0, at + 6));
        }
        ids
    }

    /// The chunks, each with the hash of the next one.
    fn pieces(&self) -> std::slice::Chunks<'a, u8> {
        self.chunks.chunks(HASH + (1 << self.head.chunk()))
    }

    /// Checks it as this device would.
    ///
    /// # Errors
    /// The rule that it breaks.
    pub fn verify(&self, device: &Device<'_>) -> Result<Opened, Refusal> {
        let head = self.head;
        let (root, recipient, epoch) = self.judge(device)?;
        let certificate = head.certificate();
        let signed_by = match certificate {
            None => root,
            Some(certificate) => {
                if !root.verifies(certificate.signed(), &certificate.signature()) {
                    return Err(Refusal::CertificateSignature(root.id()));
                }
                let bad = Refusal::Certificate("it contains no valid key");
                PublicKey::new(certificate.key()).map_err(|_| bad)?
            }
        };
        let id = signed_by.id();
        let signature = head.signature(id).ok_or(Refusal::NoSignature(id))?;
        if !signed_by.verifies(&[head.domain(), head.manifest()].concat(), signature) {
            return Err(Refusal::Signature(id));
        }
        let mut payload = self.payload()?;
        let mut opened = Opened { image: None, closed: None, signed_by, root, epoch };
        if head.flags() & flag::ENCRYPTED != 0 {
            let Some((kek, recipient)) = recipient else {
                return Ok(Opened { closed: Some(Closed::Encrypted), ..opened });
            };
            let recipient = Recipient(&recipient);
            let (check, key) = wrap(kek.secret(), &head.nonce(), &recipient.wrapped());
            if check != recipient.check() {
                return Err(Refusal::WrongKek(kek.id()));
            }
            chacha20(&mut payload, &key, &head.nonce());
        }
        if head.flags() & flag::COMPRESSED != 0 {
            let base = match (head.flags() & flag::DICTIONARY != 0, device.base) {
                (false, _) => &[][..],
                (true, None) => return Ok(Opened { closed: Some(Closed::Dictionary), ..opened }),
                (true, Some(base)) if hash(base) != head.dictionary() => return Err(Refusal::Dictionary),
                (true, Some(base)) => base,
            };
            if head.size() > MAX_PROGRAM_SIZE {
                return Err(Refusal::Field("the image is larger than any flash"));
            }
            let image = lzma::decompress(&payload, head.size() as usize, base);
            payload = image.ok_or(Refusal::Compression)?;
        }
        if hash(&payload) != head.image_hash() {
            return Err(Refusal::Hash);
        }
        let (found, said) = (CRC.checksum(&payload), head.crc());
        if found != said {
            return Err(Refusal::Crc { found, said });
        }
        opened.image = Some(payload);
        Ok(opened)
    }

    /// The payload, if the chain of hashes is valid.
    fn payload(&self) -> Result<Vec<u8>, Refusal> {
        let of = self.pieces().len();
        let mut next = self.head.chain();
        let mut payload = Vec::with_capacity(self.chunks.len());
        for (number, piece) in (1..).zip(self.pieces()) {
            if hash(piece) != next {
                return Err(Refusal::Chain { number, of });
            }
            next = array(piece, 0);
            payload.extend_from_slice(&piece[HASH..]);
        }
        // The last chunk has no successor, and its hash field is zero.
        if next != [0; HASH] {
            return Err(Refusal::Chain { number: of, of });
        }
        Ok(payload)
    }

    /// The rules that a device checks before the signature, with the device's own code. Returns the
    /// root, the key-encryption key with the recipient's record, and the epoch.
    #[allow(clippy::type_complexity)]
    fn judge(
        &self,
        device: &Device<'_>,
    ) -> Result<(PublicKey, Option<(Kek, [u8; RECIPIENT])>, u32), Refusal> {
        let head = self.head;
        // A device has room for only a few keys; the relevant ones are put into it.
        let wanted = |id: u32| match head.certificate() {
            Some(certificate) => certificate.root_id() == id,
            None => head.signature(id).is_some(),
        };
        let roots: Vec<PublicKey> = device.roots.iter().copied().filter(|root| wanted(root.id())).collect();
        let ids: Vec<u32> = self.recipients().map(|recipient| recipient.key_id()).collect();
        let keks: Vec<&Kek> = device.keks.iter().filter(|kek| ids.contains(&kek.id())).collect();
        let closed = device.keks.is_empty();
        let in_block: Vec<(u32, [u8; 32])> = if closed {
            // Without a key nothing is decrypted; the rules only look at the id of a recipient.
            ids.iter().map(|id| (*id, [0; 32])).collect()
        } else {
            keks.iter().map(|kek| (kek.id(), [0; 32])).collect()
        };
        let root_ids: Vec<_> = roots.iter().map(|root| (root.id(), root.bytes())).collect();
        let keys = key_block::of_ids(&root_ids, &in_block, 0, 0, device.for_tests);
        let as_wanted = head.hardware().trailing_zeros() & 31;
        let device = seal::judge::Device {
            vendor_id: device.vendor_id.unwrap_or(head.vendor_id()),
            product_code: device.product_code.unwrap_or(head.product_code()),
            revision: device.revision.unwrap_or(as_wanted),
            unique_id: device.unique_id.unwrap_or(head.unique_id()),
            program: device.program.unwrap_or(head.program()),
            has: self.requirements(),
            is_data: head.flags() & flag::DATA != 0,
            room: device.room.unwrap_or(u32::MAX),
            counter: device.counter,
            epoch: device.epoch,
            keys: &keys,
        };
        let needs = judge(head, &device).map_err(|fault| self.why(fault, &device))?;
        let id = word(&keys, needs.root);
        let root = roots.into_iter().find(|root| root.id() == id).ok_or(Refusal::Root(id))?;
        let recipient = needs.recipient.filter(|_| !closed).and_then(|(_, at)| {
            let record = array(head.0, at);
            let id = Recipient(&record).key_id();
            keks.into_iter().find(|kek| kek.id() == id).map(|kek| (kek.clone(), record))
        });
        Ok((root, recipient, needs.epoch))
    }

    /// What the device of a bootloader's RAM image must have; a program needs no device whose bootloader can
    /// be renewed.
    fn requirements(&self) -> Option<Requirements> {
        let record = self.head.records().find(|(tag, _)| *tag == tag::BOOTLOADER);
        record
            .filter(|_| self.head.program() == BOOTLOADER)
            .and_then(|(_, record)| Requirements::parse(record))
    }

    /// The rule that a fault breaks.
    fn why(&self, fault: Fault, device: &seal::judge::Device<'_>) -> Refusal {
        let head = self.head;
        match fault {
            Fault::Format => Refusal::Field(self.field()),
            Fault::WrongVendor => Refusal::Vendor { image: head.vendor_id(), device: device.vendor_id },
            Fault::WrongProduct if head.product_code() != device.product_code => {
                Refusal::Product { image: head.product_code(), device: device.product_code }
            }
            Fault::WrongProduct if head.program() != device.program => {
                Refusal::Program { image: head.program(), device: device.program }
            }
            Fault::WrongProduct if head.program() == BOOTLOADER && device.has.is_none() => {
                Refusal::Field("it does not say what the device of a bootloader must have")
            }
            Fault::WrongProduct if head.program() == BOOTLOADER && head.flags() & OF_PROGRAMS != 0 => {
                Refusal::Field("it has a flag that only programs have")
            }
            Fault::WrongProduct if ![[0; 12], device.unique_id].contains(&head.unique_id()) => {
                Refusal::UniqueId
            }
            Fault::WrongProduct => Refusal::Hardware { mask: head.hardware(), device: device.revision },
            Fault::Address => Refusal::TooLarge { image: head.size(), device: device.room },
            Fault::Rollback if head.counter() < device.counter => {
                Refusal::Counter { image: head.counter(), device: device.counter }
            }
            Fault::Rollback => {
                let image = head.certificate().map_or(0, Certificate::epoch);
                Refusal::Epoch { image, device: device.epoch }
            }
            Fault::Signature => Refusal::Certificate(self.certificate_field(device)),
            Fault::Key => self.key(device),
        }
    }

    fn field(&self) -> &'static str {
        let head = self.head;
        let has = |which: u8| head.flags() & which != 0;
        match () {
            () if head.flags() & !flag::KNOWN != 0 => "it has an unknown flag",
            () if head.format() > FORMAT => "it needs a newer bootloader",
            () if head.size() == 0 || head.payload() == 0 => "it is empty",
            () if !has(flag::COMPRESSED) && head.payload() != head.size() => {
                "payload and image have different sizes, and it is not compressed"
            }
            () if !has(flag::COMPRESSED) && has(flag::DICTIONARY) => {
                "it has a dictionary but is not compressed"
            }
            () => "it has an unknown record that is marked as mandatory",
        }
    }

    fn certificate_field(&self, device: &seal::judge::Device<'_>) -> &'static str {
        let Some(certificate) = self.head.certificate() else { return "it is missing" };
        match () {
            () if usize::from(certificate.size()) != CERTIFICATE => "its size is impossible",
            () if u16::from(certificate.algorithm()) != ED25519 => "its key is for another algorithm",
            () if self.head.program() == BOOTLOADER && certificate.role() != role::BOOTLOADER => {
                "its key does not sign bootloaders"
            }
            () if self.head.program() != BOOTLOADER
                && ![role::RELEASE, role::TEST].contains(&certificate.role()) =>
            {
                "its key does not sign programs"
            }
            () if certificate.reserved() != [0; RESERVED] => {
                "its reserved bytes are not 0: it is of a later format"
            }
            () if certificate.vendor_id() != device.vendor_id => "it is for another vendor",
            () if ![0, device.product_code].contains(&certificate.product_code()) => {
                "it is for another product"
            }
            () => "it does not allow this security counter",
        }
    }

    fn key(&self, device: &seal::judge::Device<'_>) -> Refusal {
        use seal::key_block::{find, KEKS, KEK_COUNT, ROOTS, ROOT_COUNT};
        let certificate = self.head.certificate();
        match certificate.map(Certificate::root_id) {
            Some(id) if find(device.keys, ROOTS, ROOT_COUNT, id).is_none() => return Refusal::Root(id),
            None if word(device.keys, ROOTS) == 0 => return Refusal::NoCertificate,
            _ => {}
        }
        let known = |id| find(device.keys, KEKS, KEK_COUNT, id).is_some();
        let encrypted = self.head.flags() & flag::ENCRYPTED != 0;
        if encrypted && !self.recipients().any(|recipient| known(recipient.key_id())) {
            return Refusal::Kek;
        }
        Refusal::Test
    }
}

/// Flags that a bootloader's RAM image has not.
const OF_PROGRAMS: u8 = flag::DICTIONARY | flag::DATA | flag::WRITES_FLASH;

/// Checks a file as this device would.
///
/// # Errors
/// The first rule that it breaks.
pub fn verify(bytes: &[u8], device: &Device<'_>) -> Result<Opened, Refusal> {
    Sealed::parse(bytes)?.verify(device)
}
