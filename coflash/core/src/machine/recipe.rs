//! The recipe of a package, `machine.toml`: which files become which programs of which devices.

use std::collections::BTreeSet;
use std::fmt::Display;
use std::path::{Path, PathBuf};

use canopen::NodeId;
use seal::wire::BOOTLOADER;
use serde::Deserialize;

use super::manifest::{Entry, Identity};
use super::package::{target, Part};
use crate::device::Dialect;
use crate::file::board::{self, in_folder};
use crate::file::{block_file, limit, ram_image, Place, ReadError};
use crate::update::job;
use crate::update::{line_of, ContentFault, Payload, Reading};

/// A recipe.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct File {
    name: Option<String>,
    release: Option<String>,
    board: Option<String>,
    #[serde(default, rename = "program")]
    programs: Vec<Row>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct Row {
    name: Option<String>,
    image: PathBuf,
    board: Option<String>,
    #[serde(default)]
    nodes: Vec<u8>,
    vendor: Option<u32>,
    product: Option<u32>,
    revision: Option<u32>,
    count: Option<u8>,
    program: Option<u8>,
    dialect: Option<String>,
    trial_run: Option<bool>,
    verify: Option<bool>,
    /// Whether the devices must be those that the file names.
    #[serde(skip)]
    check_target: bool,
}

/// The parts of a package, with its texts.
#[derive(Debug)]
pub struct Recipe {
    /// The machine, for people.
    pub name: Option<String>,
    /// The release, for people.
    pub release: Option<String>,
    /// The programs, in the order of the update.
    pub parts: Vec<Part>,
    /// The file of each.
    pub images: Vec<PathBuf>,
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
    /// Parses a recipe in this folder, and reads, judges and converts its files.
    ///
    /// # Errors
    /// The first error in the recipe or in one of its files.
    pub fn read(text: &str, folder: &Path) -> Result<Self, RecipeFault> {
        let file: File = toml::from_str(text)
            .map_err(|error| RecipeFault::Line(line_of(text, &error), error.message().to_owned()))?;
        if file.programs.is_empty() {
            return Err(RecipeFault::Line(1, "it names no program: write a [[program]] for each".to_owned()));
        }
        let mut parts = Vec::new();
        let images = file.programs.iter().map(|row| folder.join(&row.image)).collect();
        for (number, row) in (1..).zip(file.programs) {
            let part = row.part(file.board.as_deref(), folder);
            parts.push(part.map_err(|what| RecipeFault::Program(number, what))?);
        }
        Ok(Self { name: file.name, release: file.release, parts, images })
    }
}

impl Recipe {
    /// The recipe that does what a job file in this folder says. Devices with the same settings get one program
    /// together.
    ///
    /// # Errors
    /// The first error in the job file or in one of its images; also a device by its LSS address and a program that
    /// is not to be started, which a machine does not have.
    pub fn of_job(text: &str, folder: &Path) -> Result<Self, job::Fault> {
        let mut rows: Vec<(usize, job::Settings, Row)> = Vec::new();
        for (number, entry) in (1..).zip(job::parse(text, folder)?) {
            let wrong = |what: &str| job::Fault::Device(number, what.to_owned());
            let (Some(node), None) = (entry.node, entry.address) else {
                return Err(wrong("a machine has node-IDs: give node alone, and set it by LSS before"));
            };
            if entry.settings.start == Some(false) {
                return Err(wrong("each program of a machine is started: leave start = false out"));
            }
            match rows.iter_mut().find(|(_, settings, _)| *settings == entry.settings) {
                Some((_, _, row)) => row.nodes.push(node.get()),
                None => rows.push((number, entry.settings.clone(), Row::of_job(node, entry.settings))),
            }
        }
        let mut recipe = Self { name: None, release: None, parts: Vec::new(), images: Vec::new() };
        for (number, _, row) in rows {
            recipe.images.push(row.image.clone());
            // The paths of a job are in its folder already.
            let part = row.part(None, Path::new("")).map_err(|what| job::Fault::Device(number, what))?;
            recipe.parts.push(part);
        }
        // Two images, or one image with two settings, may have one name.
        let mut taken: BTreeSet<String> = recipe.parts.iter().map(|part| part.entry.name.clone()).collect();
        let mut met = BTreeSet::new();
        for Part { entry, .. } in &mut recipe.parts {
            if !met.insert(entry.name.clone()) {
                let mut names = (2_u32..).map(|number| format!("{} ({number})", entry.name));
                entry.name = names.find(|name| !taken.contains(name)).unwrap_or_default();
                taken.insert(entry.name.clone());
            }
        }
        Ok(recipe)
    }
}

impl Row {
    /// The program of a device of a job.
    fn of_job(node: NodeId, settings: job::Settings) -> Self {
        let job::Settings { image, board, program, check_target, trial_run, verify, .. } = settings;
        Self {
            name: None,
            // A parsed job has an image for each device.
            image: image.unwrap_or_default(),
            board,
            nodes: vec![node.get()],
            vendor: None,
            product: None,
            revision: None,
            count: None,
            program,
            dialect: None,
            trial_run,
            verify,
            check_target: check_target.unwrap_or(false),
        }
    }

    fn part(self, board: Option<&str>, folder: &Path) -> Result<Part, String> {
        let path = folder.join(&self.image);
        let dialect = match self.dialect.as_deref() {
            None => None,
            Some(name) => {
                let found = Dialect::ALL.into_iter().find(|dialect| dialect.name() == name);
                Some(found.ok_or_else(|| format!("there is no dialect {name:?}"))?)
            }
        };
        let board = self.board.as_deref().or(board).map(|word| in_folder(word, folder));
        let (program, bytes) = content(&path, board.as_deref(), self.program.unwrap_or(1), dialect)?;
        let identity = match (self.vendor, self.product) {
            (Some(vendor), Some(product)) => Some(Identity { vendor, product, revision: self.revision }),
            (None, None) if self.nodes.is_empty() || self.revision.is_some() || self.check_target => {
                let advice = match self.nodes.as_slice() {
                    [] => "give nodes, or vendor and product",
                    _ => "it cannot be checked; give no revision without vendor and product, and no check-target",
                };
                let fault = || format!("the file does not say for which device it is: {advice}");
                let target = target(&program).ok_or_else(fault)?;
                Some(Identity { revision: self.revision, ..target })
            }
            (None, None) => None,
            _ => return Err("vendor and product belong together".to_owned()),
        };
        let stem = || self.image.file_stem().map(|stem| stem.to_string_lossy().into_owned());
        let number = match &program {
            Payload::Bootloader(_) => match self.program {
                None | Some(BOOTLOADER) => BOOTLOADER,
                Some(_) => {
                    return Err("the file is a bootloader, which has no other number than 255".to_owned())
                }
            },
            _ => self.program.unwrap_or(1),
        };
        let entry = Entry {
            name: self.name.or_else(stem).unwrap_or_default(),
            file: String::new(),
            size: 0,
            sha256: String::new(),
            nodes: self.nodes,
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
        Payload::Bootloader(new) => new.bytes().to_vec(),
    };
    Ok((payload, bytes))
}
