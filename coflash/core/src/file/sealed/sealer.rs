//! Makes a sealed image from a program.
//!
//! The image is compressed and encrypted if requested, in this order, and then cut into chunks. The
//! same image, options and key give the same file, byte for byte.

use seal::wire::{
    flag, head, tag, Requirements, BOOTLOADER, CERTIFICATE, CERTIFICATE_MAGIC, ED25519, FIXED, FORMAT, HASH,
    MAGIC, MAX_CHUNK, MAX_HEAD, MAX_MANIFEST, MIN_CHUNK, RECIPIENT, RESERVED, SIGNATURE, SIGNATURE_HEADER,
};
use seal::wire::{role, Certificate as Wire};

use shared_abi::ram_image::{self, Header};

use super::cipher::{chacha20, hash, hmac, wrap};
use super::key::{Kek, PublicKey, SigningKey};
use super::lzma;
use crate::file::checksum::CRC;
use crate::file::program::MAX_PROGRAM_SIZE;

/// The prefix of the data from which an image's key and nonce are derived.
const KEY_DOMAIN: &[u8] = b"coboot image key 1\0";
/// The usual chunk: 4096 bytes of payload.
pub const CHUNK: u8 = 12;

/// Why an image cannot be sealed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SealFault {
    /// The image is empty.
    #[error("the image is empty")]
    Empty,
    /// The image is larger than any flash.
    #[error("the image has {0} bytes, more than any flash")]
    TooLarge(usize),
    /// No device accepts chunks of this size.
    #[error("a chunk of {} bytes is impossible: it must be a power of two from {} to {}", 1_u64 << (.0 & 31), 1 << MIN_CHUNK, 1 << MAX_CHUNK)]
    Chunk(u8),
    /// The program number is not a sub-index of 1F50h.
    #[error("there is no program {0}: programs are 1 to 254")]
    Program(u8),
    /// The image is no RAM image of a bootloader, or has an option that none can have.
    #[error("it cannot be sealed as a bootloader: {0}")]
    Bootloader(&'static str),
    /// The records do not fit into the manifest.
    #[error("the manifest would have {0} bytes, and at most {MAX_MANIFEST} are allowed: shorten the text, or encrypt for fewer keys")]
    Manifest(usize),
    /// The head does not fit into a device's buffer.
    #[error("the head would have {0} bytes, and a device accepts at most {MAX_HEAD}: shorten the text, or encrypt for fewer keys")]
    Head(usize),
    /// Two recipients have the same key id.
    #[error("the image would be encrypted twice for the key {0:08X}h: give each key once")]
    Twice(u32),
    /// The certificate is invalid.
    #[error("the certificate is invalid: give a file that `coflash seal keys certify` made")]
    NoCertificate,
    /// The certificate belongs to another key.
    #[error("the certificate belongs to another key: give the certificate of the signing key {0:08X}h")]
    OtherKey(u32),
    /// The certificate does not allow the image.
    #[error("the certificate allows {what} {allowed}, and the image has {wanted}: change the image, or certify the key for it")]
    NotAllowed {
        /// The field.
        what: &'static str,
        /// The certificate's value.
        allowed: String,
        /// The image's value.
        wanted: String,
    },
    /// The signature is wrong.
    #[error("this is not a signature of the key {0:08X}h over this image: sign the file that --tbs wrote (pure Ed25519), with this key")]
    Signature(u32),
    /// The file is not an unsigned sealed image.
    #[error("it is not a sealed image without a signature: give the file that was written with --tbs")]
    NotUnsigned,
}

/// The parameters for sealing an image. The default is a program for product 0 of vendor 0, neither
/// compressed nor encrypted.
#[derive(Clone, Debug)]
pub struct Sealer<'a> {
    /// The certificate of the signing key; `None` for a root key.
    pub certificate: Option<[u8; CERTIFICATE]>,
    /// Vendor-ID of the devices for which the image is (1018h/1).
    pub vendor_id: u32,
    /// Product code of these devices (1018h/2).
    pub product_code: u32,
    /// The program's version: major in bits 0–7, minor in bits 8–15, release in bits 16–31.
    pub version: u32,
    /// The security counter: a device accepts none lower than its own.
    pub counter: u32,
    /// The program's number, 1 to 254: the sub-index of 1F50h; 255 for the RAM image of a bootloader.
    pub program: u8,
    /// Binary logarithm of a chunk's payload, 9 to 13.
    pub chunk: u8,
    /// The recipients of the encryption; an empty list for an image that is not encrypted.
    pub encrypt_for: &'a [Kek],
    /// Whether the image is compressed. An image with a [`Self::base`] always is.
    pub compress: bool,
    /// The device's other program as it lies in flash: the dictionary of the compression.
    pub base: Option<&'a [u8]>,
    /// The 96-bit unique ID of the only device for which the image is, or zeros.
    pub unique_id: [u8; 12],
    /// The hardware revisions for which the image is: bit n for revision numbers (1018h/3) with n
    /// in the five lowest bits; 0 for all revisions.
    pub hardware: u32,
    /// The time of creation, in seconds since 1970; 0 if unknown.
    pub created: u64,
    /// The image is data of the application, not a program.
    pub data: bool,
    /// The application writes to flash itself: the bootloader does not lock the flash before it
    /// starts the application.
    pub writes_flash: bool,
    /// Only for devices that are marked for tests. The certificate of a test key also sets this.
    pub test: bool,
    /// Text for people.
    pub text: Option<&'a str>,
    /// SHA-512/256 of the software bill of materials.
    pub sbom: Option<[u8; HASH]>,
    /// Revision of the source code.
    pub source: Option<&'a str>,
}

impl Default for Sealer<'_> {
    fn default() -> Self {
        Self {
            certificate: None,
            vendor_id: 0,
            product_code: 0,
            version: 0,
            counter: 0,
            program: 1,
            chunk: CHUNK,
            encrypt_for: &[],
            compress: false,
            base: None,
            unique_id: [0; 12],
            hardware: 0,
            created: 0,
            data: false,
            writes_flash: false,
            test: false,
            text: None,
            sbom: None,
            source: None,
        }
    }
}

/// A sealed image without its signature.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Unsigned {
    /// The file, with zeros for the signature.
    file: Vec<u8>,
    /// The position of the signature.
    at: usize,
    key: PublicKey,
}

impl Sealer<'_> {
    /// Seals an image, given as it lies in flash: gaps are FFh.
    ///
    /// # Errors
    /// See [`SealFault`].
    pub fn seal(&self, image: &[u8], key: &SigningKey) -> Result<Vec<u8>, SealFault> {
        let unsigned = self.unsigned(image, key.public(), &key.seed())?;
        unsigned.attach(&key.sign(&unsigned.tbs()))
    }

    /// Seals an image for a key in a hardware security module: the module signs [`Unsigned::tbs`],
    /// and [`Unsigned::attach`] completes the file.
    ///
    /// Key and nonce of an encrypted image are derived from the image and from the keys of its
    /// recipients, because the module's key cannot be used for this.
    ///
    /// # Errors
    /// See [`SealFault`].
    pub fn for_module(&self, image: &[u8], key: PublicKey) -> Result<Unsigned, SealFault> {
        let secret = self.encrypt_for.iter().flat_map(|kek| *kek.secret());
        self.unsigned(image, key, &secret.collect::<Vec<u8>>())
    }

    fn unsigned(&self, image: &[u8], key: PublicKey, secret: &[u8]) -> Result<Unsigned, SealFault> {
        self.check(image, key)?;
        let compressed = self.compress || self.base.is_some();
        let mut payload = if compressed {
            lzma::compress(image, self.base.unwrap_or_default()).ok_or(SealFault::TooLarge(image.len()))?
        } else {
            image.to_vec()
        };
        let mut manifest = self.manifest(image, payload.len());
        let requirements = self.requirements(image);
        let more = requirements.map_or(0, |_| 4 + Requirements::SIZE);
        let size = manifest.len() + self.records_size() + more;
        if size > MAX_MANIFEST {
            return Err(SealFault::Manifest(size));
        }
        put(&mut manifest, head::MANIFEST_SIZE, &(size as u16).to_le_bytes());
        // Two different payloads must never have the same key and nonce: if a key stream is used
        // twice, both payloads can be recovered. Therefore everything that goes into the file is an
        // input here.
        let made = hmac(secret, &[KEY_DOMAIN, &manifest, &payload]);
        let image_key: [u8; 32] = seal::wire::array(&made, 0);
        let nonce: [u8; 16] = seal::wire::array(&made, 32);
        put(&mut manifest, head::NONCE, &nonce);
        if !self.encrypt_for.is_empty() {
            chacha20(&mut payload, &image_key, &nonce);
        }
        let (chain, chunks) = chain(&payload, 1 << self.chunk);
        put(&mut manifest, head::CHAIN, &chain);
        self.add_records(&mut manifest, &image_key, &nonce, requirements);

        let mut file = manifest;
        if let Some(certificate) = &self.certificate {
            file.extend_from_slice(certificate);
        }
        file.extend_from_slice(&key.id().to_le_bytes());
        file.extend_from_slice(&ED25519.to_le_bytes());
        file.extend_from_slice(&(SIGNATURE as u16).to_le_bytes());
        let at = file.len();
        if at + SIGNATURE > MAX_HEAD {
            return Err(SealFault::Head(at + SIGNATURE));
        }
        file.extend_from_slice(&[0; SIGNATURE]);
        file.extend_from_slice(&chunks);
        Ok(Unsigned { file, at, key })
    }

    fn check(&self, image: &[u8], key: PublicKey) -> Result<(), SealFault> {
        if image.is_empty() {
            return Err(SealFault::Empty);
        }
        let longest = image.len().max(self.base.unwrap_or_default().len());
        if longest > MAX_PROGRAM_SIZE as usize {
            return Err(SealFault::TooLarge(longest));
        }
        if !(MIN_CHUNK..=MAX_CHUNK).contains(&self.chunk) {
            return Err(SealFault::Chunk(self.chunk));
        }
        if self.program == 0 {
            return Err(SealFault::Program(self.program));
        }
        if self.program == BOOTLOADER {
            self.check_bootloader(image)?;
        }
        let ids: Vec<u32> = self.encrypt_for.iter().map(Kek::id).collect();
        if let Some((_, id)) = ids.iter().enumerate().find(|(at, id)| ids[..*at].contains(id)) {
            return Err(SealFault::Twice(*id));
        }
        match &self.certificate {
            Some(certificate) => self.check_certificate(certificate, key),
            None => Ok(()),
        }
    }

    /// Refuses a RAM image that no device would accept: what its header says, the manifest has to say, too.
    fn check_bootloader(&self, image: &[u8]) -> Result<(), SealFault> {
        let Some(header) = bootloader_header(image) else {
            return Err(SealFault::Bootloader("the image does not begin with a header (CBI2)"));
        };
        match () {
            () if header.crc == 0 => {
                Err(SealFault::Bootloader("it has no CRC: build it by `cargo xtask build`"))
            }
            () if header.counter != self.counter => Err(SealFault::Bootloader(
                "its header has another security counter: the product chooses it (renewal.counter)",
            )),
            () if self.data || self.writes_flash || self.base.is_some() => {
                Err(SealFault::Bootloader("it is no data, writes no flash, and has no dictionary"))
            }
            () => Ok(()),
        }
    }

    /// Refuses a certificate with which no device would accept the image.
    fn check_certificate(&self, bytes: &[u8; CERTIFICATE], key: PublicKey) -> Result<(), SealFault> {
        let certificate = Wire(bytes);
        let known = bytes.starts_with(&CERTIFICATE_MAGIC)
            && usize::from(certificate.size()) == CERTIFICATE
            && u16::from(certificate.algorithm()) == ED25519
            && self.roles().contains(&certificate.role())
            && certificate.reserved() == [0; RESERVED];
        if !known {
            return Err(SealFault::NoCertificate);
        }
        if certificate.key() != key.bytes() {
            return Err(SealFault::OtherKey(key.id()));
        }
        let not_allowed =
            |what, allowed: String, wanted: String| Err(SealFault::NotAllowed { what, allowed, wanted });
        if certificate.vendor_id() != self.vendor_id {
            let (allowed, wanted) = (certificate.vendor_id(), self.vendor_id);
            return not_allowed("the vendor-ID", format!("{allowed:08X}h"), format!("{wanted:08X}h"));
        }
        if ![0, self.product_code].contains(&certificate.product_code()) {
            let (allowed, wanted) = (certificate.product_code(), self.product_code);
            return not_allowed("the product code", format!("{allowed:08X}h"), format!("{wanted:08X}h"));
        }
        let (lowest, highest) = (certificate.lowest(), certificate.highest());
        if !(lowest..=highest).contains(&self.counter) {
            let allowed = format!("from {lowest} to {highest}");
            return not_allowed("security counters", allowed, self.counter.to_string());
        }
        Ok(())
    }

    /// The roles of a key that signs such an image.
    fn roles(&self) -> &'static [u8] {
        if self.program == BOOTLOADER {
            &[role::BOOTLOADER]
        } else {
            &[role::RELEASE, role::TEST]
        }
    }

    /// The fixed fields, still without nonce, chain and size.
    fn manifest(&self, image: &[u8], payload: usize) -> Vec<u8> {
        let certified_test = self.certificate.as_ref().is_some_and(|bytes| Wire(bytes).role() == role::TEST);
        let flags = [
            (!self.encrypt_for.is_empty(), flag::ENCRYPTED),
            (self.compress || self.base.is_some(), flag::COMPRESSED),
            (self.base.is_some(), flag::DICTIONARY),
            (self.data, flag::DATA),
            (self.writes_flash, flag::WRITES_FLASH),
            (self.test || certified_test, flag::TEST),
        ];
        let flags = flags.iter().filter(|(set, _)| *set).fold(0, |flags, (_, flag)| flags | flag);
        let mut bytes = vec![0; FIXED];
        let mut put = |at: usize, field: &[u8]| put(&mut bytes, at, field);
        put(0, &MAGIC);
        put(head::SIGNATURES, &[1]);
        put(head::FLAGS, &[flags]);
        put(head::VENDOR_ID, &self.vendor_id.to_le_bytes());
        put(head::PRODUCT_CODE, &self.product_code.to_le_bytes());
        put(head::VERSION, &self.version.to_le_bytes());
        put(head::COUNTER, &self.counter.to_le_bytes());
        put(head::PROGRAM, &[self.program]);
        put(head::CHUNK, &[self.chunk]);
        put(head::FORMAT, &FORMAT.to_le_bytes());
        // `check` limits the size of the image, and so of the LZMA data, far below 4 GiB.
        put(head::SIZE, &(image.len() as u32).to_le_bytes());
        put(head::CRC, &CRC.checksum(image).to_le_bytes());
        put(head::PAYLOAD, &(payload as u32).to_le_bytes());
        put(head::IMAGE_HASH, &hash(image));
        put(head::UNIQUE_ID, &self.unique_id);
        put(head::HARDWARE, &self.hardware.to_le_bytes());
        put(head::CREATED, &self.created.to_le_bytes());
        if let Some(base) = self.base {
            put(head::DICTIONARY, &hash(base));
        }
        bytes
    }

    /// The records for people. Zeros fill a text to whole words: there are no gaps between the
    /// records of a manifest.
    fn notes(&self) -> impl Iterator<Item = (u16, Vec<u8>)> {
        let words = |tag, text: &str| {
            let mut bytes = text.as_bytes().to_vec();
            bytes.resize(bytes.len().next_multiple_of(4), 0);
            (tag, bytes)
        };
        let text = self.text.map(|text| words(tag::TEXT, text));
        let sbom = self.sbom.map(|sbom| (tag::SBOM, sbom.to_vec()));
        let source = self.source.map(|source| words(tag::SOURCE, source));
        [text, sbom, source].into_iter().flatten()
    }

    /// What the device of a bootloader's RAM image must have: what its header says.
    fn requirements(&self, image: &[u8]) -> Option<Requirements> {
        let header = bootloader_header(image).filter(|_| self.program == BOOTLOADER)?;
        Some(Requirements { board: header.board, services: header.services, features: header.features.0 })
    }

    fn records_size(&self) -> usize {
        let notes: usize = self.notes().map(|(_, bytes)| 4 + bytes.len()).sum();
        notes + self.encrypt_for.len() * (4 + RECIPIENT)
    }

    fn add_records(
        &self,
        manifest: &mut Vec<u8>,
        image_key: &[u8; 32],
        nonce: &[u8; 16],
        requirements: Option<Requirements>,
    ) {
        let mut add = |tag: u16, parts: &[&[u8]]| {
            let size: usize = parts.iter().map(|part| part.len()).sum();
            manifest.extend_from_slice(&tag.to_le_bytes());
            // The manifest's size was checked, and this is a part of it.
            manifest.extend_from_slice(&(size as u16).to_le_bytes());
            parts.iter().for_each(|part| manifest.extend_from_slice(part));
        };
        for kek in self.encrypt_for {
            let (check, wrapped) = wrap(kek.secret(), nonce, image_key);
            add(tag::RECIPIENT, &[&kek.id().to_le_bytes(), &check, &wrapped]);
        }
        for (tag, bytes) in self.notes() {
            add(tag, &[&bytes]);
        }
        if let Some(requirements) = requirements {
            add(tag::BOOTLOADER, &[&requirements.bytes()]);
        }
    }
}

impl Unsigned {
    /// The bytes to be signed with pure Ed25519: the domain and the manifest.
    #[must_use]
    pub fn tbs(&self) -> Vec<u8> {
        let head = seal::wire::Head(&self.file);
        [head.domain(), head.manifest()].concat()
    }

    /// The file with zeros for the signature.
    #[must_use]
    pub fn file(&self) -> &[u8] {
        &self.file
    }

    /// Continues with a stored file of an image for this signing key.
    ///
    /// # Errors
    /// [`SealFault::NotUnsigned`], [`SealFault::OtherKey`].
    pub fn of_file(file: Vec<u8>, key: PublicKey) -> Result<Self, SealFault> {
        let head = match seal::wire::head_size(&file) {
            Ok(size) if size <= file.len() => size,
            _ => return Err(SealFault::NotUnsigned),
        };
        let certificate = seal::wire::Head(&file[..head]).certificate();
        let of_another = certificate.is_some_and(|certificate| certificate.key() != key.bytes());
        let at = head.checked_sub(SIGNATURE).ok_or(SealFault::NotUnsigned)?;
        let header = at.checked_sub(SIGNATURE_HEADER).ok_or(SealFault::NotUnsigned)?;
        let id = seal::wire::word(&file, header);
        match seal::wire::Head(&file[..head]).signature(id) {
            Some(zeros) if *zeros == [0; SIGNATURE] && seal::wire::Head(&file).signatures() == 1 => {}
            _ => return Err(SealFault::NotUnsigned),
        }
        if of_another || id != key.id() {
            return Err(SealFault::OtherKey(id));
        }
        Ok(Self { file, at, key })
    }

    /// The sealed image with its signature.
    ///
    /// # Errors
    /// [`SealFault::Signature`] for one that does not fit.
    pub fn attach(&self, signature: &[u8; SIGNATURE]) -> Result<Vec<u8>, SealFault> {
        if !self.key.verifies(&self.tbs(), signature) {
            return Err(SealFault::Signature(self.key.id()));
        }
        let mut file = self.file.clone();
        file[self.at..self.at + SIGNATURE].copy_from_slice(signature);
        Ok(file)
    }
}

/// The header of a bootloader's RAM image, if the image is one.
fn bootloader_header(image: &[u8]) -> Option<Header> {
    let header = Header::of_bytes(image.first_chunk()?);
    (header.magic == ram_image::MAGIC).then_some(header)
}

/// Writes a field of the manifest.
fn put(manifest: &mut [u8], at: usize, field: &[u8]) {
    manifest[at..at + field.len()].copy_from_slice(field);
}

/// Cuts payload into chunks: the hash of the first, and all of them.
fn chain(payload: &[u8], chunk: usize) -> ([u8; HASH], Vec<u8>) {
    let mut next = [0; HASH];
    let mut chunks: Vec<Vec<u8>> = Vec::new();
    for data in payload.chunks(chunk).rev() {
        let bytes = [&next[..], data].concat();
        next = hash(&bytes);
        chunks.push(bytes);
    }
    chunks.reverse();
    (next, chunks.concat())
}
