//! The recipe `machine.toml`: which files become which programs of which devices. `coflash package` makes a
//! package of it, and `coflash flash --job` carries it out as it is, without signatures.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use canopen::NodeId;
use seal::wire::BOOTLOADER;
use serde::de::IgnoredAny;
use serde::Deserialize;
use toml::Spanned;

use super::manifest::{Entry, Identity};
use super::package::{target, Part};
use crate::device::lss::LssAddress;
use crate::device::Dialect;
use crate::file::board::{self, in_folder};
use crate::file::{block_file, limit, ram_image, Place, ReadError, Target};
use crate::update::{line_in, line_of, ContentFault, Payload, Reading};

/// A recipe. Its paths begin in its folder.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct Recipe {
    /// The machine, for people.
    pub name: Option<String>,
    /// The release, for people.
    pub release: Option<String>,
    /// The board of all programs that name none.
    board: Option<String>,
    /// The programs, in the order of the update.
    #[serde(default, rename = "program")]
    pub programs: Vec<Row>,
}

/// A program of a recipe, and the devices that get it.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
#[non_exhaustive]
pub struct Row {
    /// Its name, for people; by default that of the file.
    pub name: Option<String>,
    /// The firmware file.
    pub image: PathBuf,
    /// The board: its name, or the file with its memory map.
    pub board: Option<String>,
    /// The node-IDs of the devices.
    #[serde(default)]
    pub nodes: Vec<u8>,
    /// The LSS address of the one device, which gets its node-ID by it. Not in a package.
    lss: Option<Lss>,
    vendor: Option<u32>,
    product: Option<u32>,
    revision: Option<u32>,
    count: Option<u8>,
    /// The program number.
    pub program: Option<u8>,
    dialect: Option<String>,
    /// Whether the devices must be those that the file names.
    pub check_target: Option<bool>,
    /// Whether the program is tried before it is released for autostart.
    pub trial_run: Option<bool>,
    /// Whether the program is started at the end. In a package each is.
    pub start: Option<bool>,
    /// Whether the CRC is compared once more at the very end.
    pub verify: Option<bool>,
}

/// An LSS address.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Lss {
    vendor: u32,
    product: u32,
    revision: u32,
    serial: u32,
}

/// A device of a recipe that is carried out as it is.
#[derive(Debug)]
#[non_exhaustive]
pub struct RecipeDevice<'r> {
    /// Its node-ID, or the node-ID to set.
    pub node: Option<NodeId>,
    /// Its LSS address, if the recipe names it by that.
    pub address: Option<LssAddress>,
    /// Its dialect, if the recipe names it.
    pub dialect: Option<Dialect>,
    /// What it gets.
    pub row: &'r Row,
}

/// A job file of before has these.
#[derive(Deserialize)]
struct Before {
    device: Option<Spanned<IgnoredAny>>,
}

/// An error in a recipe, with its place.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RecipeFault {
    /// In this line.
    #[error("line {0}: {1}")]
    Line(usize, String),
    /// In the program of this number, counted from 1.
    #[error("program {0}: {1}")]
    Program(usize, String),
}

impl Recipe {
    /// Parses a recipe in this folder. It has at least one program.
    ///
    /// # Errors
    /// The first error in the recipe.
    pub fn parse(text: &str, folder: &Path) -> Result<Self, RecipeFault> {
        let line = |line, what: &str| Err(RecipeFault::Line(line, what.to_owned()));
        let of = |error: toml::de::Error| line(line_of(text, &error), error.message());
        match toml::from_str(text) {
            Ok(Before { device: Some(device) }) => {
                return line(
                    line_in(text, device.span().start),
                    "[[device]] is of the job files of before: write a [[program]] with image and \
                     nodes = [...] for each program",
                );
            }
            Ok(Before { device: None }) => {}
            Err(error) => return of(error),
        }
        let mut recipe: Self = match toml::from_str(text) {
            Ok(recipe) => recipe,
            Err(error) => return of(error),
        };
        if recipe.programs.is_empty() {
            return line(1, "it names no program: write a [[program]] for each");
        }
        for row in &mut recipe.programs {
            row.image = folder.join(&row.image);
            let board = row.board.as_ref().or(recipe.board.as_ref());
            row.board = board.map(|word| in_folder(word, folder));
        }
        Ok(recipe)
    }

    /// The parts of a package: reads, judges and converts the files.
    ///
    /// # Errors
    /// The first error in one of the programs or its file; also a device by its LSS address and a program
    /// that is not to be started, which a machine does not have.
    pub fn parts(&self) -> Result<Vec<Part>, RecipeFault> {
        self.rows()
            .map(|(number, row)| row.part().map_err(|what| RecipeFault::Program(number, what)))
            .collect()
    }

    /// The devices of a recipe that is carried out without a package. Each has a node-ID or an LSS address,
    /// and no two have the same.
    ///
    /// # Errors
    /// The first device that breaks these rules, and what only a package has.
    pub fn devices(&self) -> Result<Vec<RecipeDevice<'_>>, RecipeFault> {
        let mut devices: Vec<RecipeDevice<'_>> = Vec::new();
        for (number, row) in self.rows() {
            let wrong = |what: &str| RecipeFault::Program(number, what.to_owned());
            for device in row.devices().map_err(|what| wrong(&what))? {
                let same = |other: &RecipeDevice<'_>| {
                    (device.node.is_some() && other.node == device.node)
                        || (device.address.is_some() && other.address == device.address)
                };
                if devices.iter().any(same) {
                    return Err(wrong("the recipe has one of its devices twice"));
                }
                devices.push(device);
            }
        }
        Ok(devices)
    }

    fn rows(&self) -> impl Iterator<Item = (usize, &Row)> {
        (1..).zip(&self.programs)
    }
}

impl Row {
    /// The dialect of the devices; without it, it is detected.
    fn dialect(&self) -> Result<Option<Dialect>, String> {
        let Some(name) = self.dialect.as_deref() else { return Ok(None) };
        Dialect::named(name).map(Some).ok_or_else(|| format!("there is no dialect {name:?}"))
    }

    /// The identity of the devices, if the recipe names it.
    fn identity(&self) -> Result<Option<Identity>, String> {
        match (self.vendor, self.product) {
            (Some(vendor), Some(product)) => Ok(Some(Identity { vendor, product, revision: self.revision })),
            (None, None) => Ok(None),
            _ => Err("vendor and product belong together".to_owned()),
        }
    }

    /// The identity that the devices must have.
    #[must_use]
    pub fn target(&self) -> Option<Target> {
        Some(Target { vendor_id: self.vendor?, product_code: self.product? })
    }

    fn devices(&self) -> Result<Vec<RecipeDevice<'_>>, String> {
        let dialect = self.dialect()?;
        self.identity()?;
        let address = self.lss.as_ref().map(|lss| LssAddress {
            vendor_id: lss.vendor,
            product_code: lss.product,
            revision: lss.revision,
            serial_number: lss.serial,
        });
        let device = |node| RecipeDevice { node, address, dialect, row: self };
        let nodes: Option<Vec<_>> = self.nodes.iter().map(|node| NodeId::new(*node)).collect();
        let nodes = nodes.ok_or("node-IDs are 1 to 127")?;
        let fault = match nodes.as_slice() {
            _ if self.revision.is_some() || self.count.is_some() => {
                "only a package has revision and count: leave them out, or make a package"
            }
            _ if self.program.is_some_and(|program| !(1..=254).contains(&program)) => "programs are 1 to 254",
            [] if self.lss.is_none() => {
                "it has neither nodes nor lss; only the devices of a package are searched for"
            }
            [_, _, ..] if self.lss.is_some() => "one LSS address cannot get several node-IDs",
            [] => return Ok(vec![device(None)]),
            nodes => return Ok(nodes.iter().copied().map(Some).map(device).collect()),
        };
        Err(fault.to_owned())
    }

    fn part(&self) -> Result<Part, String> {
        if self.lss.is_some() {
            return Err("a machine has node-IDs: give nodes alone, and set them by LSS before".to_owned());
        }
        if self.start == Some(false) {
            return Err("each program of a machine is started: leave start = false out".to_owned());
        }
        let dialect = self.dialect()?;
        let (program, bytes) =
            content(&self.image, self.board.as_deref(), self.program.unwrap_or(1), dialect)?;
        let checks = self.revision.is_some() || self.check_target == Some(true);
        let identity = match self.identity()? {
            None if self.nodes.is_empty() || checks => {
                let advice = match self.nodes.as_slice() {
                    [] => "give nodes, or vendor and product",
                    _ => "it cannot be checked; give no revision without vendor and product, and no check-target",
                };
                let fault = || format!("the file does not say for which device it is: {advice}");
                Some(Identity { revision: self.revision, ..target(&program).ok_or_else(fault)? })
            }
            identity => identity,
        };
        let stem = || self.image.file_stem().map(|stem| stem.to_string_lossy().into_owned());
        let number = match (program.is_bootloader(), self.program) {
            (true, None | Some(BOOTLOADER)) => BOOTLOADER,
            (true, Some(_)) => {
                return Err("the file is a bootloader, which has no other number than 255".to_owned())
            }
            (false, number) => number.unwrap_or(1),
        };
        let entry = Entry {
            name: self.name.clone().or_else(stem).unwrap_or_default(),
            file: String::new(),
            size: 0,
            sha256: String::new(),
            nodes: self.nodes.clone(),
            identity,
            count: self.count,
            program: number,
            dialect: dialect.map(|dialect| dialect.name().to_owned()),
            trial_run: self.trial_run.unwrap_or(true),
            verify: self.verify.unwrap_or(false),
        };
        Ok(Part { entry, bytes })
    }
}

/// Reads and judges a firmware file, as `coflash flash` does, and gives it in the form for a package.
fn content(
    path: &Path,
    board: Option<&str>,
    number: u8,
    dialect: Option<Dialect>,
) -> Result<(Payload, Vec<u8>), String> {
    let of = |error: ReadError| error.of(path.display()).to_string();
    let said = |what: &dyn Display| format!("{}: {what}", path.display());
    let bytes = limit::read(path).map_err(|cause| of(Place::File.fault(cause)))?;
    let board = board.map(board::named).transpose().map_err(|error| error.to_string())?;
    let loaded = Reading::new(number).board(board).dialect(dialect).read(path, &bytes);
    let payload = loaded
        .map_err(|fault| match fault {
            ContentFault::Bootloader(fault) => said(&format!("it {fault}: {}", ram_image::Fault::ADVICE)),
            ContentFault::Sealed(refusal) => said(&format!("{refusal}: {}", refusal.advice())),
            ContentFault::File(error) => of(error),
            ContentFault::Judged(fault) => said(&format!("the image {fault}: {}", fault.advice())),
            fault @ ContentFault::NoProgram { .. } => fault.to_string(),
            fault @ ContentFault::Convert(_) => said(&fault),
        })?
        .payload;
    let bytes = match &payload {
        Payload::Program(program) => block_file::emit(program),
        Payload::Sealed(file) => file.bytes().to_vec(),
        Payload::Bootloader(image) => image.bytes().to_vec(),
    };
    Ok((payload, bytes))
}
