//! `coflash seal keys`: keys for sealed images, and certificates of signing keys.

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand, ValueEnum};
use coflash_core::file::sealed::key::hexadecimal;
use coflash_core::file::sealed::show::{digits, role_name, CertificateWords};
use coflash_core::file::sealed::{Certificate, Kek, KeyFault, PublicKey, Role, SigningKey};
use seal::wire::{self, CERTIFICATE, CERTIFICATE_MAGIC};
use serde_json::json;

use crate::context::Context;
use crate::objects::bytes_of;
use crate::output::Failure;
use crate::output_file::{exists, write, write_secret, LARGEST_KEY};
use crate::values::number;

/// Makes keys for sealed images, certifies them, and shows them.
///
/// A root key certifies the keys that sign programs; devices hold the root's public key. A
/// key-encryption key (kek) decrypts encrypted programs; devices hold it, so it is as secret as the
/// private keys.
#[derive(Debug, Args)]
pub(crate) struct Keys {
    #[command(subcommand)]
    job: Job,
}

#[derive(Debug, Subcommand)]
enum Job {
    /// Make a key. Only the owner of the file can read the private part.
    New(New),
    /// Certify a key that signs programs, with a root key.
    Certify(Certify),
    /// Show a key or a certificate, but no secrets.
    Show(Show),
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum KeyRole {
    /// Certifies the signing keys. Keep it offline.
    Root,
    /// Signs programs.
    Release,
    /// Decrypts encrypted programs.
    Kek,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum SigningRole {
    /// Programs for the field.
    Release,
    /// Programs for devices that are marked for tests.
    Test,
    /// Bootloaders, and no programs. Its holder is as powerful as that of a root.
    Bootloader,
}

#[derive(Debug, Args)]
struct New {
    /// The purpose of the key. Root and release keys are Ed25519 keys in PKCS#8 PEM, as OpenSSL
    /// makes them.
    #[arg(long, value_name = "ROLE")]
    role: KeyRole,

    /// The file for the private key; by default the role's name with .pem. The public key goes into
    /// a file of the same name with .pub.
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,

    /// Make the key-encryption key from this value of 128 bits, in 32 hexadecimal digits, which the
    /// manual's tools use for encryption.
    #[arg(long, value_name = "HEX128", value_parser = value_of_128_bits)]
    of_value: Option<[u8; 16]>,

    /// Replace existing files. Programs and certificates made with the old key remain valid for the
    /// old key only.
    #[arg(long = "force")]
    overwrite: bool,
}

#[derive(Debug, Args)]
struct Certify {
    /// The root's private key.
    #[arg(long, value_name = "FILE")]
    root: PathBuf,

    /// The public key to certify.
    #[arg(long, value_name = "FILE")]
    key: PathBuf,

    /// The epoch: a device that has accepted a program with a higher epoch refuses this key.
    #[arg(long, value_name = "NUMBER", value_parser = number)]
    epoch: u32,

    /// Vendor-ID of the devices (1018h/1).
    #[arg(long, alias = "vid", value_name = "NUMBER", value_parser = number)]
    vendor: u32,

    /// Product code of the devices (1018h/2); by default all products of the vendor.
    #[arg(long, alias = "pid", value_name = "NUMBER", value_parser = number, default_value = "0")]
    product: u32,

    /// The lowest security counter of the programs that the key may sign.
    #[arg(long, value_name = "NUMBER", value_parser = number, default_value = "0")]
    lowest: u32,

    /// The highest security counter of the programs that the key may sign.
    #[arg(long, value_name = "NUMBER", value_parser = number, default_value = "0xFFFFFFFF")]
    highest: u32,

    /// What the key may sign.
    #[arg(long, value_name = "ROLE", default_value = "release")]
    role: SigningRole,

    /// The file for the certificate; by default the key's name with .cert.
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct Show {
    /// A private key, a public key, a key-encryption key or a certificate.
    #[arg(value_name = "FILE")]
    file: PathBuf,
}

/// The contents of a sealed device's key block.
#[derive(Debug, Args)]
pub(crate) struct KeyBlock {
    /// The public key of a root; give the option once for each root.
    #[arg(long, value_name = "FILE", required = true)]
    root: Vec<PathBuf>,

    /// A key-encryption key of the device, which decrypts encrypted images; give the option once
    /// for each key.
    #[arg(long, value_name = "FILE")]
    kek: Vec<PathBuf>,

    /// The lowest security counter that the device accepts, for every program.
    #[arg(long, value_name = "NUMBER", value_parser = number, default_value = "0")]
    pub(crate) counter: u32,

    /// The lowest epoch of a certificate that the device accepts.
    #[arg(long, value_name = "NUMBER", value_parser = number, default_value = "0")]
    pub(crate) epoch: u32,

    /// Mark the device for tests: it also accepts programs signed with test keys.
    #[arg(long)]
    pub(crate) for_tests: bool,
}

impl KeyBlock {
    /// The keys in the named files: roots and key-encryption keys.
    pub(crate) fn keys(&self) -> Result<(Vec<PublicKey>, Vec<Kek>), Failure> {
        let roots = self.root.iter().map(|path| public_key(path)).collect::<Result<_, Failure>>()?;
        Ok((roots, keks(&self.kek)?))
    }
}

/// Parses 16 bytes in hexadecimal digits. The error does not repeat the value, which is secret.
pub(crate) fn value_of_128_bits(text: &str) -> Result<[u8; 16], String> {
    let digits = text.strip_prefix("0x").unwrap_or(text);
    let bytes = hexadecimal(digits).and_then(|bytes| bytes.try_into().ok());
    bytes.ok_or_else(|| "it must have 32 hexadecimal digits".to_string())
}

impl Keys {
    pub(crate) fn run(&self, context: &Context) -> Result<(), Failure> {
        match &self.job {
            Job::New(new) => new.run(context),
            Job::Certify(certify) => certify.run(context),
            Job::Show(show) => show.run(context),
        }
    }
}

impl New {
    fn run(&self, context: &Context) -> Result<(), Failure> {
        let (name, is_kek) = match self.role {
            KeyRole::Root => ("root", false),
            KeyRole::Release => ("release", false),
            KeyRole::Kek => ("kek", true),
        };
        if self.of_value.is_some() && !is_kek {
            let advice = "leave --of-value out, or make a key-encryption key: --role kek";
            return Err(Failure::usage("a value can only make a key-encryption key", advice));
        }
        let output = self.output.clone().unwrap_or_else(|| PathBuf::from(format!("{name}.pem")));
        let fault = |fault: KeyFault| Failure::system(fault.to_string());
        let (id, public) = if is_kek {
            let kek = self.of_value.map_or_else(Kek::generate, Kek::of_value).map_err(fault)?;
            write_secret(&output, kek.to_pem(), self.overwrite)?;
            (kek.id(), None)
        } else {
            let public = output.with_extension("pub");
            if public == output {
                let what = format!("{} is the name of the public key's file", output.display());
                return Err(Failure::usage(what, "give the private key's file a name with .pem"));
            }
            if !self.overwrite && public.exists() {
                return Err(exists(&public));
            }
            let key = SigningKey::generate().map_err(fault)?;
            write_secret(&output, key.to_pem(), self.overwrite)?;
            write(&public, key.public().to_pem().as_bytes())?;
            (key.public().id(), Some(public))
        };
        let beside = public
            .as_ref()
            .map_or_else(String::new, |public| format!(", its public key in {}", public.display()));
        let kind = if is_kek { "key-encryption" } else { name };
        let words = format!("{}: {kind} key {id:08X}h{beside}; keep it secret", output.display());
        context.result(words, || {
            json!({
                "role": name,
                "id": id,
                "output": output.display().to_string(),
                "public": public.as_ref().map(|public| public.display().to_string()),
            })
        });
        Ok(())
    }
}

impl Certify {
    fn run(&self, context: &Context) -> Result<(), Failure> {
        if self.lowest > self.highest {
            let advice = "give --highest a number that is not below --lowest";
            return Err(Failure::usage("the certificate would allow no security counter", advice));
        }
        let root = signing_key(&self.root)?;
        let certificate = Certificate {
            role: match self.role {
                SigningRole::Release => Role::Release,
                SigningRole::Test => Role::Test,
                SigningRole::Bootloader => Role::Bootloader,
            },
            epoch: self.epoch,
            vendor_id: self.vendor,
            product_code: self.product,
            lowest: self.lowest,
            highest: self.highest,
            key: public_key(&self.key)?,
        };
        let bytes = certificate.signed_by(&root);
        let output = self.output.clone().unwrap_or_else(|| self.key.with_extension("cert"));
        write(&output, &bytes)?;
        let words = format!("{}: {}", output.display(), CertificateWords(wire::Certificate(&bytes)));
        context.result(words, || {
            let mut value = certificate_value(wire::Certificate(&bytes));
            value["output"] = output.display().to_string().into();
            value
        });
        Ok(())
    }
}

impl Show {
    fn run(&self, context: &Context) -> Result<(), Failure> {
        let path = &self.file;
        let bytes = bytes_of(path, LARGEST_KEY)?;
        if bytes.starts_with(&CERTIFICATE_MAGIC) {
            let bytes = certificate(path)?;
            let words = CertificateWords(wire::Certificate(&bytes));
            let words = format!("{}: certificate: {words} (its signature is not checked)", path.display());
            context.result(words, || {
                let mut value = certificate_value(wire::Certificate(&bytes));
                value["kind"] = "certificate".into();
                value
            });
            return Ok(());
        }
        let text = String::from_utf8_lossy(&bytes);
        let (kind, id, public) = if let Ok(key) = SigningKey::from_pem(&text) {
            ("private key", key.public().id(), Some(key.public()))
        } else if let Ok(key) = PublicKey::from_pem(&text) {
            ("public key", key.id(), Some(key))
        } else if let Ok(kek) = Kek::from_pem(&text) {
            ("key-encryption key", kek.id(), None)
        } else {
            let why =
                "is neither a key nor a certificate; decrypt a key with a password first (openssl pkey)";
            return Err(Failure::file(path, why));
        };
        let public = public.map(|key| digits(&key.bytes()));
        let more = public.as_ref().map_or_else(String::new, |public| format!(", public key {public}"));
        context.result(
            format!("{}: {kind} {id:08X}h{more}", path.display()),
            || json!({ "kind": kind, "id": id, "public_key": public }),
        );
        Ok(())
    }
}

/// The JSON value of a certificate.
pub(crate) fn certificate_value(certificate: wire::Certificate<'_>) -> serde_json::Value {
    json!({
        "role": role_name(certificate.role()),
        "epoch": certificate.epoch(),
        "vendor_id": certificate.vendor_id(),
        "product_code": certificate.product_code(),
        "lowest": certificate.lowest(),
        "highest": certificate.highest(),
        "key": digits(&certificate.key()),
        "key_id": PublicKey::new(certificate.key()).ok().map(|key| key.id()),
        "root_id": certificate.root_id(),
    })
}

fn text(path: &Path) -> Result<String, Failure> {
    Ok(String::from_utf8_lossy(&bytes_of(path, LARGEST_KEY)?).into_owned())
}

/// The private key in a file.
pub(crate) fn signing_key(path: &Path) -> Result<SigningKey, Failure> {
    SigningKey::from_pem(&text(path)?).map_err(|fault| Failure::file(path, fault))
}

/// The public key in a file. The file may also hold a private key.
pub(crate) fn public_key(path: &Path) -> Result<PublicKey, Failure> {
    let text = text(path)?;
    match SigningKey::from_pem(&text) {
        Ok(key) => Ok(key.public()),
        Err(_) => PublicKey::from_pem(&text).map_err(|fault| Failure::file(path, fault)),
    }
}

/// The key-encryption keys in files.
pub(crate) fn keks(paths: &[PathBuf]) -> Result<Vec<Kek>, Failure> {
    let kek = |path: &PathBuf| Kek::from_pem(&text(path)?).map_err(|fault| Failure::file(path, fault));
    paths.iter().map(kek).collect()
}

/// Reads a certificate. Its contents are checked where it is used.
pub(crate) fn certificate(path: &Path) -> Result<[u8; CERTIFICATE], Failure> {
    let bytes = bytes_of(path, LARGEST_KEY)?;
    let bytes = Some(bytes).filter(|bytes| bytes.starts_with(&CERTIFICATE_MAGIC));
    let why = "is not a certificate: coflash seal keys certify makes one";
    bytes.and_then(|bytes| bytes.try_into().ok()).ok_or_else(|| Failure::file(path, why))
}
