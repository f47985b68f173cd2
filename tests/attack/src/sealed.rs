//! Sealed images: the keys of these tests, and files that tests can change.

use std::sync::OnceLock;

use coflash_core::file::sealed::{hash, key_block, Certificate, Kek, Role, Sealer, SigningKey};
use kit::rig::{program, PRODUCT_CODE, VENDOR_ID};
use seal::access::{CHALLENGE, DOMAIN as ACCESS_DOMAIN, SIGNED_CHALLENGE};
use seal::wire::{head_size, CERTIFICATE, DOMAIN, ED25519};
use shared_abi::geometry::Region;

/// The keys of these tests.
pub struct Keys {
    /// In every key block.
    pub root: SigningKey,
    /// The second root of every key block.
    pub second_root: SigningKey,
    /// A key certified by the root.
    pub release: SigningKey,
    /// A key without a certificate.
    pub stranger: SigningKey,
    /// The key-encryption key of the devices.
    pub keks: [Kek; 1],
    /// A key-encryption key that no device has.
    pub other_keks: [Kek; 1],
}

/// See [`Keys`].
pub fn keys() -> &'static Keys {
    static KEYS: OnceLock<Keys> = OnceLock::new();
    let signing = |seed| SigningKey::from_seed([seed; 32]).expect("its id is not 0");
    let kek = |byte| Kek::new([byte; 32]).expect("its id is not 0");
    KEYS.get_or_init(|| Keys {
        root: signing(1),
        second_root: signing(2),
        release: signing(3),
        stranger: signing(4),
        keks: [kek(5)],
        other_keks: [kek(6)],
    })
}

/// The epoch of [`certificate`].
pub const EPOCH: u32 = 4;
/// The highest counter of [`certificate`].
pub const HIGHEST: u32 = 1000;

/// The root's certificate for the release key: any product, counters up to [`HIGHEST`].
#[must_use]
pub fn certificate() -> Certificate {
    Certificate {
        role: Role::Release,
        epoch: EPOCH,
        vendor_id: VENDOR_ID,
        product_code: 0,
        lowest: 0,
        highest: HIGHEST,
        key: keys().release.public(),
    }
}

/// The key block of every sealed device here, unless a test sets another one.
#[must_use]
pub fn default_keys() -> [u8; 256] {
    let Keys { root, second_root, keks, .. } = keys();
    key_block(&[root.public(), second_root.public()], keks, 0, 0, false).expect("it has room for them")
}

/// Whether an image is encrypted, and whether it is compressed.
pub const FORMS: [(bool, bool); 4] = [(false, false), (true, false), (false, true), (true, true)];

/// For an image of program 1 with counter 5 and version 1, signed by the release key.
#[must_use]
pub fn sealer((encrypted, compress): (bool, bool)) -> Sealer<'static> {
    static CERTIFICATE_BYTES: OnceLock<[u8; CERTIFICATE]> = OnceLock::new();
    Sealer {
        certificate: Some(*CERTIFICATE_BYTES.get_or_init(|| certificate().signed_by(&keys().root))),
        vendor_id: VENDOR_ID,
        product_code: PRODUCT_CODE,
        version: 1,
        counter: 5,
        encrypt_for: if encrypted { &keys().keks } else { &[] },
        compress,
        ..Sealer::default()
    }
}

/// Seals with the release key.
#[must_use]
pub fn seal(sealer: &Sealer<'_>, image: &[u8]) -> Vec<u8> {
    sealer.seal(image, &keys().release).expect("it can be sealed")
}

/// A program for this region: vectors, a label, and distinct bytes.
#[must_use]
pub fn image(region: Region, len: usize, seed: u8) -> Vec<u8> {
    program(region, PRODUCT_CODE, len, seed)
}

/// A request for rights, signed by this key for this challenge (2002h/1).
#[must_use]
pub fn request(challenge: &[u8; CHALLENGE], root: &SigningKey, rights: u32, argument: u32) -> Vec<u8> {
    let mut request = kit::rig::words(&[rights, argument, root.public().id()]);
    let message = [&ACCESS_DOMAIN[..], &challenge[..SIGNED_CHALLENGE], &request].concat();
    request.extend(root.sign(&message));
    request
}

/// A sealed image in its parts, which tests can change.
#[derive(Clone)]
pub struct Parts {
    /// The manifest, including its own size.
    pub manifest: Vec<u8>,
    /// The certificate; empty for none.
    pub certificate: Vec<u8>,
    /// The signatures with their headers.
    pub signatures: Vec<u8>,
    /// All chunks.
    pub chunks: Vec<u8>,
}

impl Parts {
    /// Splits a file with one signature.
    #[must_use]
    pub fn of(file: &[u8]) -> Self {
        let mut have = 8;
        let head = loop {
            match head_size(&file[..have]).expect("it is a sealed image") {
                size if size == have => break have,
                size => have = size,
            }
        };
        let manifest = usize::from(u16::from_le_bytes([file[4], file[5]]));
        Self {
            manifest: file[..manifest].to_vec(),
            certificate: file[manifest..head - 72].to_vec(),
            signatures: file[head - 72..head].to_vec(),
            chunks: file[head..].to_vec(),
        }
    }

    /// Replaces bytes in the manifest.
    #[must_use]
    pub fn with(mut self, at: usize, bytes: &[u8]) -> Self {
        self.manifest[at..at + bytes.len()].copy_from_slice(bytes);
        self
    }

    /// Appends a record to the manifest; `size` is its announced size.
    #[must_use]
    pub fn with_record(mut self, tag: u16, size: u16, bytes: &[u8]) -> Self {
        self.manifest.extend(tag.to_le_bytes());
        self.manifest.extend(size.to_le_bytes());
        self.manifest.extend(bytes);
        let size = self.manifest.len() as u16;
        self.with(4, &size.to_le_bytes())
    }

    /// Replaces the certificate, and signs correctly.
    #[must_use]
    pub fn certified(mut self, certificate: &[u8]) -> Self {
        self.certificate = certificate.to_vec();
        self
    }

    /// Replaces the payload, in chunks of the size in the manifest.
    #[must_use]
    pub fn with_payload(self, payload: &[u8]) -> Self {
        let mut next = [0; 32];
        let mut chunks: Vec<Vec<u8>> = Vec::new();
        for data in payload.chunks(1 << self.manifest[25]).rev() {
            let chunk = [&next[..], data].concat();
            next = hash(&chunk);
            chunks.push(chunk);
        }
        chunks.reverse();
        let size = payload.len() as u32;
        Self { chunks: chunks.concat(), ..self }.with(36, &size.to_le_bytes()).with(72, &next)
    }

    /// Its payload, if it is not encrypted.
    #[must_use]
    pub fn payload(&self) -> Vec<u8> {
        self.chunks.chunks(32 + (1 << self.manifest[25])).flat_map(|chunk| &chunk[32..]).copied().collect()
    }

    /// Signs with only this key.
    #[must_use]
    pub fn signed_by(mut self, key: &SigningKey) -> Self {
        self.signatures = Self::signature(key, &self.manifest);
        self
    }

    /// A signature with its header.
    #[must_use]
    pub fn signature(key: &SigningKey, manifest: &[u8]) -> Vec<u8> {
        let signature = key.sign(&[&DOMAIN[..], manifest].concat());
        [&key.public().id().to_le_bytes()[..], &ED25519.to_le_bytes(), &64_u16.to_le_bytes(), &signature]
            .concat()
    }

    /// Signed by the release key.
    #[must_use]
    pub fn signed(self) -> Vec<u8> {
        self.signed_by(&keys().release).bytes()
    }

    /// The file.
    #[must_use]
    pub fn bytes(&self) -> Vec<u8> {
        [&self.manifest[..], &self.certificate, &self.signatures, &self.chunks].concat()
    }

    /// The number of bytes before the chunks.
    #[must_use]
    pub fn head(&self) -> usize {
        self.manifest.len() + self.certificate.len() + self.signatures.len()
    }
}
