//! A package: its members, read, checked and parsed, before anything of it is used.

use std::path::Path;

use canopen::NodeId;
use sha2::{Digest as _, Sha256};

use super::fault::Fault;
use super::manifest::{self, Entry, Identity, Manifest};
use super::signature::{self, Signer};
use super::zip::{self, Member, MAX_MEMBER};
use crate::device::Dialect;
use crate::file::judge::judge;
use crate::file::sealed::show::digits;
use crate::file::sealed::{PublicKey, SealedFile, SigningKey};
use crate::file::{self, checksum, Firmware, Format, Target};
use crate::update::dialect::is_data;
use crate::update::{Marks, Payload};
use seal::wire::CERTIFICATE;

/// A package whose members were checked.
#[derive(Clone, Debug)]
pub struct Package {
    manifest: Manifest,
    checksums: (String, u32),
    /// The bytes that are signed.
    signed: Vec<u8>,
    signers: Vec<Signer>,
    programs: Vec<Payload>,
    /// The marks of each: its CRC goes over its whole span, and every device is compared with it.
    marks: Vec<Marks>,
}

/// Whether a file begins as a package: with its manifest.
#[must_use]
pub fn looks_like(front: &[u8]) -> bool {
    zip::looks_like(front) && front.get(30..).is_some_and(|name| name.starts_with(manifest::NAME.as_bytes()))
}

/// Whether a file with this name is one for a machine: by its ending, or because it begins as a package. A file
/// with this ending that is no package is refused as one, so that its name does not get it past the roots that
/// its user trusts.
#[must_use]
pub fn is_package(name: &Path, front: &[u8]) -> bool {
    name.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("cpk")) || looks_like(front)
}

/// The bytes that [`looks_like`] needs.
pub const FRONT: usize = 64;

impl Package {
    /// Reads a package and checks all of it: each member has the size and the hash of the manifest, no two
    /// programs are for one node, each signature whose key is known is good, and each program can be one
    /// of its devices. Nothing of it is unpacked.
    ///
    /// # Errors
    /// The first [`Fault`].
    pub fn parse(bytes: &[u8]) -> Result<Self, Fault> {
        let members = zip::read(bytes)?;
        let mut rest = members.as_slice();
        let first = rest.split_off_first().filter(|member| member.name == manifest::NAME);
        let signed = first.ok_or(Fault::NotPackage("its first member is not its manifest"))?.bytes;
        let manifest = Manifest::parse(signed)?;
        let mut signers = Vec::new();
        if let [Member { name: signature::NAME, bytes }, programs @ ..] = rest {
            signers = signature::parse(bytes)?;
            signature::verify(&signers, signed)?;
            signature::covered(&signers, &manifest)?;
            rest = programs;
        }
        let is_listed =
            |member: &&Member<'_>| manifest.programs.iter().any(|entry| entry.file == member.name);
        if let Some(member) = rest.iter().find(|member| !is_listed(member)) {
            return Err(Fault::Unlisted(member.name.to_owned()));
        }
        let mut programs = Vec::new();
        for entry in &manifest.programs {
            let member = rest.iter().find(|member| member.name == entry.file);
            let member = member.ok_or_else(|| Fault::Missing(entry.file.clone()))?;
            let differs = |what| Fault::Damaged { member: entry.file.clone(), what };
            if member.bytes.len() as u64 != entry.size {
                return Err(differs("size"));
            }
            if entry.hash() != Some(Sha256::digest(member.bytes).into()) {
                return Err(differs("SHA-256"));
            }
            programs.push(program(entry, member.bytes)?);
        }
        let marks = programs.iter().map(Payload::marks).collect();
        let checksums = (digits(&Sha256::digest(bytes)), checksum::CRC.checksum(bytes));
        Ok(Self { checksums, manifest, signed: signed.to_vec(), signers, programs, marks })
    }

    /// Checks that one of these roots has signed the package, or certified its signers. Returns the signers
    /// of these roots; nothing is known of the others.
    ///
    /// # Errors
    /// [`Fault::Signature`].
    pub fn trust(&self, roots: &[PublicKey]) -> Result<Vec<Signer>, Fault> {
        Ok(signature::trust(&self.signers, &self.manifest, &self.signed, roots)?)
    }

    /// Its manifest.
    #[must_use]
    pub const fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// SHA-256 of its bytes, in 64 hexadecimal digits, and CRC-32 (ISO 3309), as everybody has a tool for.
    #[must_use]
    pub fn checksums(&self) -> (&str, u32) {
        (&self.checksums.0, self.checksums.1)
    }

    /// The keys that have signed it.
    #[must_use]
    pub fn signers(&self) -> &[Signer] {
        &self.signers
    }

    /// Its programs in the order of the update, with their entries in the manifest.
    pub fn programs(&self) -> impl ExactSizeIterator<Item = (&Entry, &Payload)> {
        self.manifest.programs.iter().zip(&self.programs)
    }

    /// The nodes that it names.
    pub fn nodes(&self) -> impl Iterator<Item = NodeId> + '_ {
        self.manifest.programs.iter().flat_map(|entry| &entry.nodes).filter_map(|node| NodeId::new(*node))
    }

    /// When the newest of its programs was made, in seconds since 1970 (UTC), if any says so.
    #[must_use]
    pub fn date(&self) -> Option<u64> {
        self.programs.iter().filter_map(Payload::date).max()
    }

    /// What a device reports that has this program.
    pub(super) fn marks(&self, entry: usize) -> Option<&Marks> {
        self.marks.get(entry)
    }

    pub(super) fn program(&self, entry: usize) -> Option<(&Entry, &Payload)> {
        self.manifest.programs.get(entry).zip(self.programs.get(entry))
    }
}

/// A part of a package that is made: an entry without size and hash, which follow from the bytes.
#[derive(Clone, Debug)]
pub struct Part {
    /// The entry; `file`, `size` and `sha256` are filled in.
    pub entry: Entry,
    /// The content of the member.
    pub bytes: Vec<u8>,
}

/// Makes a package of these parts, signed by these keys. The same input gives the same bytes.
///
/// # Errors
/// The first rule that it breaks: the result is read again as any other package.
pub fn make(
    name: Option<String>,
    release: Option<String>,
    parts: &[Part],
    keys: &[(&SigningKey, Option<[u8; CERTIFICATE]>)],
) -> Result<Vec<u8>, Fault> {
    let entry = |(number, part): (usize, &Part)| Entry {
        file: format!("program-{number}.{}", extension(&part.bytes)),
        size: part.bytes.len() as u64,
        sha256: digits(&Sha256::digest(&part.bytes)),
        ..part.entry.clone()
    };
    let manifest = Manifest::new(name, release, (1..).zip(parts).map(entry).collect())?;
    let bytes = manifest.emit();
    let signatures = if keys.is_empty() { None } else { Some(signature::sign(&manifest, keys)?) };
    let mut members = vec![Member { name: manifest::NAME, bytes: &bytes }];
    members.extend(signatures.iter().map(|bytes| Member { name: signature::NAME, bytes }));
    let programs = manifest.programs.iter().zip(parts);
    members.extend(programs.map(|(entry, part)| Member { name: &entry.file, bytes: &part.bytes }));
    let package = zip::write(&members);
    Package::parse(&package)?;
    Ok(package)
}

/// The ending of a member with these bytes.
fn extension(bytes: &[u8]) -> &'static str {
    match Format::detect(bytes) {
        Some(Format::Sealed) => "cbs",
        Some(_) => "blk",
        None => "bin",
    }
}

/// The program in a member: blocks, a sealed image, or the RAM image of a bootloader.
fn program(entry: &Entry, bytes: &[u8]) -> Result<Payload, Fault> {
    let unusable = |why: String| Fault::Program { program: entry.name.clone(), why };
    let format = Format::detect(bytes);
    let program = match format {
        Some(Format::Sealed) | None if entry.is_bootloader() => {
            let new = Payload::bootloader_in(bytes, format.or(Some(Format::Raw)));
            let no_bootloader = match format {
                Some(_) => "it is a sealed program and no bootloader",
                None => "it is no bootloader",
            };
            let new = new.map_err(|fault| unusable(format!("it {fault}")))?;
            new.ok_or_else(|| unusable(no_bootloader.to_owned()))?
        }
        Some(Format::Sealed) => {
            let file = SealedFile::for_program(bytes.to_vec(), entry.program);
            Payload::from(file.map_err(|refusal| unusable(refusal.to_string()))?)
        }
        Some(Format::BlockFile) if !entry.is_bootloader() => {
            let blocks = match file::read(bytes, format, None).map_err(|error| unusable(error.to_string()))? {
                Firmware::Blocks(blocks) => blocks,
                Firmware::Image(_) => return Err(unusable("it has no blocks".to_owned())),
            };
            if blocks.size() as usize > MAX_MEMBER {
                // The gaps between blocks cost the file nothing, and each CRC its time.
                let what =
                    format!("it extends over {} bytes, and at most {MAX_MEMBER} are allowed", blocks.size());
                return Err(unusable(what));
            }
            if !is_data(entry.dialect().unwrap_or(Dialect::Lift), entry.program) {
                let judged = judge(blocks.image(), blocks.start(), None);
                judged.map_err(|fault| unusable(format!("the image {fault}")))?;
            }
            Payload::from(blocks)
        }
        _ => return Err(unusable("it is neither a block file nor a sealed image".to_owned())),
    };
    let Some((wanted, said)) = entry.identity.zip(program.target()) else { return Ok(program) };
    // 0 is any, as for a device.
    let other = |wanted: u32, said: u32| said != 0 && said != wanted;
    if other(wanted.vendor, said.vendor_id) || other(wanted.product, said.product_code) {
        let whose = Identity { vendor: said.vendor_id, product: said.product_code, revision: None };
        return Err(unusable(format!("it is for {whose}, and the package has it for {wanted}")));
    }
    Ok(program)
}

/// The type of device that a program names; two zeros name none.
pub(super) fn target(program: &Payload) -> Option<Identity> {
    let Target { vendor_id: vendor, product_code: product } = program.target()?;
    (vendor != 0 || product != 0).then_some(Identity { vendor, product, revision: None })
}

/// The version of a program, if it has one.
#[must_use]
pub fn version(program: &Payload) -> Option<String> {
    let bootloader = program.bootloader().map(|version| version.to_string());
    bootloader.or_else(|| Some(program.version()?.to_string()))
}

/// The kind of a program, in words.
#[must_use]
pub fn kind(program: &Payload) -> &'static str {
    match program {
        Payload::Program(_) => "program",
        Payload::Sealed(_) if program.is_bootloader() => "sealed bootloader",
        Payload::Sealed(_) => "sealed program",
        Payload::Bootloader(_) => "bootloader",
    }
}
