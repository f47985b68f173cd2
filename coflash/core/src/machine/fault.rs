//! Why a package cannot be used: what is wrong, a stable number, and what to do.

use canopen::NodeId;

use crate::file::sealed::show::role_name;

/// The first of the numbers of packages.
const BASE: u32 = 0x6000_0400;

/// What a package has a limit for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Limit {
    /// The number of its members.
    Members,
    /// The length of a name.
    Name,
    /// The size of a member.
    Member,
    /// The size of the manifest.
    Manifest,
    /// The number of its programs.
    Programs,
    /// The number of node-IDs of a program.
    Nodes,
}

impl Limit {
    /// Compares a value with its limit.
    pub(super) fn check(self, found: usize, most: usize) -> Result<(), Fault> {
        if found > most {
            return Err(Fault::Limit { what: self, found, most });
        }
        Ok(())
    }

    const fn words(self) -> &'static str {
        match self {
            Self::Members => "members",
            Self::Name => "characters in a name",
            Self::Member => "bytes in a member",
            Self::Manifest => "bytes in its manifest",
            Self::Programs => "programs",
            Self::Nodes => "node-IDs for a program",
        }
    }
}

/// Why a package cannot be used. `Display` says what is wrong, as the rest of a sentence that begins with
/// the file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Fault {
    /// It is no package, or damaged beyond its members.
    #[error("is not a package for a machine: {0}")]
    NotPackage(&'static str),
    /// A member is compressed or encrypted.
    #[error("is not a package for a machine: {0:?} is compressed or encrypted, and a package has its members as they are")]
    Packed(String),
    /// A later format.
    #[error("is a package of format {found}, and this coflash knows format {known}")]
    Newer {
        /// Its format.
        found: u32,
        /// The format that is known here.
        known: u32,
    },
    /// It exceeds a limit.
    #[error("has {found} {words}, and at most {most} are allowed", words = .what.words())]
    Limit {
        /// The kind of the limit.
        what: Limit,
        /// The value in the file.
        found: usize,
        /// The limit.
        most: usize,
    },
    /// A member has a name that is a path, or has characters that no name has.
    #[error("has a member with the name {0:?}: names have letters, digits, '-', '_' and '.' only")]
    Name(String),
    /// Two members have one name.
    #[error("has two members with the name {0:?}")]
    Twice(String),
    /// A member that the manifest does not list.
    #[error("has a member {0:?} that its manifest does not list")]
    Unlisted(String),
    /// The manifest lists a member that is not there.
    #[error("has no member {0:?}, which its manifest lists")]
    Missing(String),
    /// A member differs from what the manifest or the directory says.
    #[error("has another {what} of {member:?} than it says")]
    Damaged {
        /// The member.
        member: String,
        /// What differs.
        what: &'static str,
    },
    /// The manifest is invalid.
    #[error("has an invalid manifest: {0}")]
    Manifest(String),
    /// Two programs that one node could match.
    #[error("has two programs for one node: {first:?} and {second:?} both write program {number} of {whom}")]
    TwoPrograms {
        /// The earlier one.
        first: String,
        /// The later one.
        second: String,
        /// The program number.
        number: u8,
        /// The devices.
        whom: String,
    },
    /// The bytes of a program are not usable.
    #[error("has a program {program:?} that is not usable: {why}")]
    Program {
        /// Its name.
        program: String,
        /// The reason.
        why: String,
    },
    /// Signatures.
    #[error("{0}")]
    Signature(#[from] SignatureFault),
}

/// What is wrong with the signatures of a package.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SignatureFault {
    /// Their member is malformed.
    #[error("has signatures that cannot be read: {0}")]
    Malformed(&'static str),
    /// A signature is wrong.
    #[error("was changed after it was signed: the signature of key {0:08X}h does not match")]
    Wrong(u32),
    /// Nobody has signed it, and the user has named roots.
    #[error("is not signed")]
    None,
    /// None of the named roots has signed it or certified its signer.
    #[error("is signed by a stranger: key {key:08X}h{}", .root.map_or(String::new(), |root| format!(", certified by root {root:08X}h")))]
    Stranger {
        /// The key that has signed.
        key: u32,
        /// The root that its certificate names.
        root: Option<u32>,
    },
    /// No signer may sign this program.
    #[error("is signed by key {key:08X}h, which may sign {what}, and not the program {program:?}")]
    NotAllowed {
        /// The key.
        key: u32,
        /// What its certificate allows.
        what: String,
        /// The program.
        program: String,
    },
}

impl SignatureFault {
    /// What a certificate allows.
    pub(super) fn allowed(role: u8, vendor: u32, product: u32) -> String {
        let product = if product == 0 { String::new() } else { format!(", product {product:08X}h") };
        format!("for role {:?}, vendor {vendor:08X}h{product}", role_name(role))
    }
}

impl Fault {
    /// The stable error number.
    #[must_use]
    pub const fn number(&self) -> u32 {
        BASE + match self {
            Self::NotPackage(_) | Self::Packed(_) => 0,
            Self::Newer { .. } => 1,
            Self::Limit { .. } => 2,
            Self::Name(_) | Self::Twice(_) => 3,
            Self::Unlisted(_) | Self::Missing(_) => 4,
            Self::Damaged { .. } => 5,
            Self::Manifest(_) => 6,
            Self::TwoPrograms { .. } => 7,
            Self::Signature(_) => 8,
            Self::Program { .. } => 9,
        }
    }

    /// What to do next.
    #[must_use]
    pub const fn advice(&self) -> &'static str {
        match self {
            Self::NotPackage(_) | Self::Packed(_) => {
                "give the file that coflash package wrote, unchanged; copy it again if it was cut off"
            }
            Self::Newer { .. } => "use a newer coflash; nothing was changed",
            Self::Limit { .. } => "make several packages of it, or ask its maker: it may be damaged on purpose",
            Self::Name(_) | Self::Twice(_) | Self::Unlisted(_) | Self::Missing(_) | Self::Damaged { .. } => {
                "do not use it: somebody has changed it, or the copy is bad; get it again from its maker"
            }
            Self::Manifest(_) | Self::Program { .. } => "make the package again with coflash package",
            Self::TwoPrograms { .. } => {
                "give each node one program of this number: name nodes, a product or a revision that only one of them has"
            }
            Self::Signature(SignatureFault::None) => {
                "get the signed package, or leave --trust out to take the file as it is"
            }
            Self::Signature(SignatureFault::Stranger { .. }) => {
                "do not use it unless you know this key; --trust names the roots that you trust"
            }
            Self::Signature(SignatureFault::NotAllowed { .. }) => {
                "sign it with a key whose certificate covers this program, as well: coflash package --key, once for each"
            }
            Self::Signature(_) => "do not use it: get the package again from its maker",
        }
    }
}

/// Why a device of a plan was not updated, if it is not an error of the conversation with it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DeviceFault {
    /// It did not answer the scan.
    #[error("node {node} is not on the bus")]
    Absent {
        /// The device.
        node: NodeId,
    },
    /// It answered the scan, but not as a device whose identity can be compared.
    #[error("node {node} answers, but {but}")]
    Mute {
        /// The device.
        node: NodeId,
        /// What is wrong with its answers.
        but: String,
    },
    /// Fewer devices than the package says.
    #[error("the package wants {expected} devices for {program:?}, and the bus has {found}")]
    TooFew {
        /// The name of the program.
        program: String,
        /// The number in the package.
        expected: usize,
        /// The number on the bus.
        found: usize,
    },
    /// The device at a named node is another one.
    #[error("node {node} is another device than the package says: its {what} is {device}, and {program:?} is for {package}")]
    OtherDevice {
        /// The device.
        node: NodeId,
        /// The program.
        program: String,
        /// The part of its identity.
        what: &'static str,
        /// Its value.
        device: String,
        /// The value in the package.
        package: String,
    },
    /// It is another device than in the plan.
    #[error("node {node} is another device now than in the plan: its {what} was {was}, and is {is}")]
    Exchanged {
        /// The device.
        node: NodeId,
        /// The part of its identity.
        what: &'static str,
        /// The value in the plan.
        was: String,
        /// The value now.
        is: String,
    },
    /// The device has a newer version, and nobody has allowed an older one.
    #[error("node {node} has {has} of {program:?}, and {gets} of the package is older: it was not written")]
    Older {
        /// The device.
        node: NodeId,
        /// The program.
        program: String,
        /// The version of the device.
        has: String,
        /// The version of the package.
        gets: String,
    },
    /// An earlier program of this device failed.
    #[error("{program:?} was not begun, because an earlier program of node {node} failed")]
    EarlierFailed {
        /// The device.
        node: NodeId,
        /// The program.
        program: String,
    },
}

impl DeviceFault {
    /// The stable error number.
    #[must_use]
    pub const fn number(&self) -> u32 {
        match self {
            // That of a device that does not answer.
            Self::Absent { .. } => 0x6000_0013,
            Self::TooFew { .. } => BASE + 0xA,
            Self::OtherDevice { .. } => BASE + 0xB,
            Self::Exchanged { .. } => BASE + 0xC,
            Self::EarlierFailed { .. } => BASE + 0xD,
            Self::Mute { .. } => BASE + 0xE,
            Self::Older { .. } => BASE + 0xF,
        }
    }

    /// What to do next.
    #[must_use]
    pub const fn advice(&self) -> &'static str {
        match self {
            Self::Absent { .. } => "check its plug and its node-ID, and run the command again: it updates what is missing",
            Self::Mute { .. } => {
                "nothing was written to it: find out why it answers so (coflash info), and run the command again"
            }
            Self::TooFew { .. } => {
                "check plugs and node-IDs (coflash scan), and run the command again: it updates what is missing"
            }
            Self::OtherDevice { .. } => "check that the right device is at this node-ID, or get the package for this machine",
            Self::Exchanged { .. } => "nothing was written to it: run the command again, which makes a new plan",
            Self::Older { .. } => {
                "get the newer package; if the older one is wanted, allow it: coflash flash --allow-older, a click on \
                 the service page, allow-older = true in the agent's configuration"
            }
            Self::EarlierFailed { .. } => "find out why that one failed, and run the command again",
        }
    }
}
