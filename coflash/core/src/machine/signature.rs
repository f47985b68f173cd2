//! The signatures of a package: over its manifest, which has the hash of every program.

use seal::wire::{
    self, half, role, word, CERTIFICATE, CERTIFICATE_MAGIC, ED25519, RESERVED, SIGNATURE, SIGNATURE_HEADER,
};

use super::fault::SignatureFault;
use super::manifest::{Entry, Identity, Manifest};
use crate::file::sealed::{PublicKey, SigningKey};

/// The name of their member, which follows the manifest.
pub const NAME: &str = "signatures.bin";
/// The prefix of the manifest in the signed message.
const DOMAIN: &[u8; 25] = b"coboot machine package 1\0";
/// The most signatures.
const MAX: usize = 3;

/// A key that has signed a package.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Signer {
    /// The id of the key.
    pub key: u32,
    certificate: Option<[u8; CERTIFICATE]>,
    signature: [u8; SIGNATURE],
}

/// The message that is signed.
fn message(manifest: &[u8]) -> Vec<u8> {
    [DOMAIN, manifest].concat()
}

/// Signs a manifest; the result is a member. A key without a certificate is a root.
///
/// # Errors
/// [`SignatureFault::NotAllowed`] for a program that no key may sign, and the errors of [`parse`].
pub fn sign(
    manifest: &Manifest,
    keys: &[(&SigningKey, Option<[u8; CERTIFICATE]>)],
) -> Result<Vec<u8>, SignatureFault> {
    let bytes = manifest.emit();
    let mut member = Vec::new();
    for (key, certificate) in keys {
        member.extend(certificate.as_ref().map_or(0, |_| CERTIFICATE as u16).to_le_bytes());
        member.extend([0; 2]);
        member.extend(certificate.iter().flatten());
        member.extend(key.public().id().to_le_bytes());
        member.extend(ED25519.to_le_bytes());
        member.extend((SIGNATURE as u16).to_le_bytes());
        member.extend(key.sign(&message(&bytes)));
    }
    let signers = parse(&member)?;
    verify(&signers, &bytes)?;
    covered(&signers, manifest)?;
    Ok(member)
}

/// Parses the member.
///
/// # Errors
/// [`SignatureFault::Malformed`].
pub(super) fn parse(mut bytes: &[u8]) -> Result<Vec<Signer>, SignatureFault> {
    let bad = SignatureFault::Malformed;
    let mut signers: Vec<Signer> = Vec::new();
    while !bytes.is_empty() {
        if signers.len() == MAX {
            return Err(bad("there are more than three"));
        }
        let head = take(&mut bytes, 4)?;
        let certificate = match (usize::from(half(head, 0)), half(head, 2)) {
            (0, 0) => None,
            (CERTIFICATE, 0) => Some(wire::array(take(&mut bytes, CERTIFICATE)?, 0)),
            _ => return Err(bad("the size of a certificate is wrong")),
        };
        let header = take(&mut bytes, SIGNATURE_HEADER)?;
        if (half(header, 4), usize::from(half(header, 6))) != (ED25519, SIGNATURE) {
            return Err(bad("the algorithm is not Ed25519"));
        }
        let signer = Signer {
            key: word(header, 0),
            certificate,
            signature: wire::array(take(&mut bytes, SIGNATURE)?, 0),
        };
        if signer.certificate().is_some_and(|certificate| !is_sound(certificate)) {
            return Err(bad("a certificate is invalid"));
        }
        if signer.certificate.is_some() && signer.certified().map(|key| key.id()) != Some(signer.key) {
            return Err(bad("a certificate is that of another key"));
        }
        if signers.iter().any(|other| other.key == signer.key) {
            return Err(bad("a key has signed twice"));
        }
        signers.push(signer);
    }
    if signers.is_empty() {
        return Err(bad("there are none"));
    }
    Ok(signers)
}

/// Checks each signature whose key the package has. That of a root without a certificate is checked when
/// the root is known.
///
/// # Errors
/// [`SignatureFault::Wrong`].
pub(super) fn verify(signers: &[Signer], manifest: &[u8]) -> Result<(), SignatureFault> {
    let message = message(manifest);
    let is_wrong =
        |signer: &&Signer| signer.certified().is_some_and(|key| !key.verifies(&message, &signer.signature));
    match signers.iter().find(is_wrong) {
        Some(signer) => Err(SignatureFault::Wrong(signer.key)),
        None => Ok(()),
    }
}

/// Checks that one of these roots has signed or certified a signer, and that each program has a signer that may
/// sign it. Returns the signers of these roots; the signature of another one was not checked.
///
/// # Errors
/// [`SignatureFault`].
pub(super) fn trust(
    signers: &[Signer],
    manifest: &Manifest,
    bytes: &[u8],
    roots: &[PublicKey],
) -> Result<Vec<Signer>, SignatureFault> {
    let first = signers.first().ok_or(SignatureFault::None)?;
    let message = message(bytes);
    let mut known = Vec::new();
    for signer in signers {
        let root = |id: u32| roots.iter().find(|root| root.id() == id);
        let is_known = match signer.certificate() {
            Some(certificate) => root(certificate.root_id())
                .is_some_and(|root| root.verifies(certificate.signed(), &certificate.signature())),
            None => match root(signer.key) {
                Some(root) if !root.verifies(&message, &signer.signature) => {
                    return Err(SignatureFault::Wrong(signer.key));
                }
                root => root.is_some(),
            },
        };
        known.extend(is_known.then(|| signer.clone()));
    }
    if known.is_empty() {
        let root = first.certificate().map(|certificate| certificate.root_id());
        return Err(SignatureFault::Stranger { key: first.key, root });
    }
    covered(&known, manifest)?;
    Ok(known)
}

/// Checks that each program has a signer that may sign it.
pub(super) fn covered(signers: &[Signer], manifest: &Manifest) -> Result<(), SignatureFault> {
    for entry in &manifest.programs {
        if signers.iter().any(|signer| signer.may_sign(entry)) {
            continue;
        }
        let what = |signer: &Signer| {
            let certificate = signer.certificate()?;
            let (vendor, product) = (certificate.vendor_id(), certificate.product_code());
            Some((signer.key, SignatureFault::allowed(certificate.role(), vendor, product)))
        };
        let (key, what) = signers.iter().find_map(what).unwrap_or_default();
        return Err(SignatureFault::NotAllowed { key, what, program: entry.name.clone() });
    }
    Ok(())
}

impl Signer {
    /// Its certificate; a root has none.
    #[must_use]
    pub fn certificate(&self) -> Option<wire::Certificate<'_>> {
        self.certificate.as_ref().map(|bytes| wire::Certificate(bytes))
    }

    /// The key in its certificate.
    fn certified(&self) -> Option<PublicKey> {
        PublicKey::new(self.certificate()?.key()).ok()
    }

    /// Whether it may sign this program: a root may sign all; a certificate is for programs or for
    /// bootloaders, and for a vendor or a product.
    fn may_sign(&self, entry: &Entry) -> bool {
        let Some(certificate) = self.certificate() else { return true };
        let role_fits = match certificate.role() {
            role::BOOTLOADER => entry.is_bootloader(),
            role::RELEASE => !entry.is_bootloader(),
            // A package is for machines, not for devices that are marked for tests.
            _ => false,
        };
        let fits = |identity: Identity| {
            certificate.vendor_id() == identity.vendor
                && [0, identity.product].contains(&certificate.product_code())
        };
        // Nodes without an identity can be anybody's.
        role_fits && entry.identity.is_some_and(fits)
    }
}

/// Whether the fixed fields of a certificate are those of the format.
fn is_sound(certificate: wire::Certificate<'_>) -> bool {
    certificate.0.starts_with(&CERTIFICATE_MAGIC)
        && usize::from(certificate.size()) == CERTIFICATE
        && u16::from(certificate.algorithm()) == ED25519
        && certificate.reserved() == [0; RESERVED]
}

fn take<'a>(bytes: &mut &'a [u8], size: usize) -> Result<&'a [u8], SignatureFault> {
    let cut = SignatureFault::Malformed("they are cut off");
    let (first, rest) = bytes.split_at_checked(size).ok_or(cut)?;
    *bytes = rest;
    Ok(first)
}
