//! Packages for machines: the ZIP file, the manifest and the signatures.
//!
//! Must hold: no bytes cause a panic; the members of a container lie in it and have names of their own, and
//! come out again when they are written anew; a package that is accepted has what its manifest says, no two
//! programs for a node that both name, and no signature that a stranger would take for its root's.
#![cfg_attr(fuzzing, no_main)]

use coflash_core::file::sealed::SigningKey;
use coflash_core::machine::zip::{self, Member, MAX_MEMBERS};
use coflash_core::machine::{Fault, Package};

/// A program, whose size and SHA-256 the kept manifests have.
const BLOCKS: &[u8] = include_bytes!("../../../coflash/core/tests/data/plain-400.blk");

fn container(bytes: &[u8]) {
    let Ok(members) = zip::read(bytes) else { return };
    assert!(members.len() <= MAX_MEMBERS);
    let all: usize = members.iter().map(|member| member.name.len() + member.bytes.len()).sum();
    assert!(all < bytes.len());
    for (at, member) in members.iter().enumerate() {
        assert!(zip::is_name(member.name) && !member.name.contains(['/', '\\', ':']));
        assert!(members[..at].iter().all(|other| !other.name.eq_ignore_ascii_case(member.name)));
    }
    let again = zip::write(&members);
    assert_eq!(zip::read(&again).as_ref(), Ok(&members));
}

fn package(bytes: &[u8]) {
    let package = match Package::parse(bytes) {
        Ok(package) => package,
        Err(fault) => {
            assert!((0x6000_0400..=0x6000_0409).contains(&fault.number()) && !fault.advice().is_empty());
            assert!(!fault.to_string().chars().any(char::is_control), "{fault}");
            return;
        }
    };
    let entries: Vec<_> = package.programs().map(|(entry, _)| entry).collect();
    for (at, entry) in entries.iter().enumerate() {
        assert!(entry.size <= bytes.len() as u64);
        assert!(!entry.nodes.is_empty() || entry.identity.is_some());
        for other in entries[..at].iter().filter(|other| other.program == entry.program) {
            let meet = other.nodes.iter().any(|node| entry.nodes.contains(node));
            assert!(!meet || other.identity.is_some() && entry.identity.is_some());
        }
    }
    // Nobody has signed with this key.
    let root = SigningKey::from_seed([0x5A; 32]).expect("a key").public();
    assert!(matches!(package.trust(&[root]), Err(Fault::Signature(_))));
}

coboot_fuzz::target!(|bytes: &[u8]| {
    // The first byte says what the others are, so that the fuzzer need not find CRC and SHA-256.
    let Some((kind, bytes)) = bytes.split_first() else { return };
    let program = Member { name: "a.blk", bytes: BLOCKS };
    let manifest = |bytes| Member { name: "manifest.json", bytes };
    match kind {
        b'z' => {
            container(bytes);
            package(bytes);
        }
        b'm' => package(&zip::write(&[manifest(bytes), program])),
        b's' => {
            // The manifest ends at the first zero.
            let end = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
            let (first, rest) = bytes.split_at(end);
            let signatures = Member { name: "signatures.bin", bytes: rest.get(1..).unwrap_or_default() };
            package(&zip::write(&[manifest(first), signatures, program]));
        }
        _ => {}
    }
});
