//! `coflash flash`: downloads a program into a device.

use std::path::{Path, PathBuf};
use std::time::Duration;

use canopen::NodeId;
use clap::{Args, Command, ValueEnum};
use coboot_can::Link;
use coflash_core::device::lock::Lock;
use coflash_core::device::lss::{ensure_node_id, LssAddress};
use coflash_core::device::Dialect;
use coflash_core::file::convert::{blocks_of_sealed, Label};
use coflash_core::file::sealed::show::flags;
use coflash_core::file::sealed::SealedFile;
use coflash_core::machine::{RecipeDevice, Row};
use coflash_core::update::many::{flash_in_turn, flash_many, Job, ManyOptions};
use coflash_core::update::{flash, Event, FlashOptions, Judging, Payload};
use seal::wire::BOOTLOADER;
use serde_json::json;
use shared_abi::block_file::ProgramVersion;

use super::context::Context;
use super::convert::Labels;
use super::device::{cancelled, Patience};
use super::dialect::Access;
use super::file::{bytes, warn, Source};
use super::legacy::Legacy;
use super::many::{begin, diagnose_silence, document, summary, write_report, Board, Outcome};
use super::output::Failure;
use super::output_file;
use super::package::{is_package, read_recipe, Given, Machine, Typed};
use super::progress::Progress;
use super::values::{nodes, number, program_number, watch_time};

/// When devices get the same program together.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Together {
    /// Devices that can; the others at the same time, each by itself.
    Auto,
    /// All devices; one that cannot is not updated.
    Always,
    /// None: each device gets it by itself.
    Never,
}

/// Downloads a program into devices, and starts it.
///
/// The file may be a block file or a sealed image; any other firmware file is converted first. The
/// tool reads and checks the whole file before it changes a device. An interrupted update can be
/// started again at once.
///
/// A file with a bootloader (bootloader.elf, or a sealed one) renews the bootloader of a device: the new one
/// runs on trial, is confirmed, and installs itself; the program stays. Of several devices the first one is
/// renewed before the others are touched.
///
/// The tool detects bootloaders of other makers by itself; --dialect names one.
///
/// With a package for a machine (coflash package) the tool scans the bus, shows its plan, asks, and
/// updates each device with its program; the package says which.
///
/// With several nodes, or with a job file, the devices are updated at the same time; if one device
/// fails, the others continue.
///
/// The options of BinaryBlockDownload and DotNetFlashtool are also accepted in their original
/// spelling (-F, --node_id, --prog_no, --chk_tgt, --chk_run, --sdo_timeout, --timeout and so on). As in
/// DotNetFlashtool, -F, --node_id and --prog_no leave the trial out unless --chk_run is given.
#[derive(Debug, Args)]
pub(super) struct Flash {
    // The first one: the parser takes each value out as it reads it.
    #[command(flatten)]
    typed: Typed,

    /// The firmware: Intel HEX, Motorola S-record, ELF, raw binary, block file or sealed image.
    #[arg(value_name = "FILE", conflicts_with = "legacy_file", required_unless_present_any = ["legacy_file", "job", "vxd_type", "index"])]
    file: Option<PathBuf>,

    /// The devices' node-IDs: 5, or a list with ranges like 1,5,9-12.
    #[arg(long, short = 'N', alias = "nodes", default_value = "1", value_parser = nodes, value_name = "NODES",
          conflicts_with = "node_id")]
    node: Vec<Vec<NodeId>>,

    /// A job file: a recipe (see the manual), which names the programs and their devices, in place of FILE
    /// and --node.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["file", "legacy_file", "node", "node_id", "vid"])]
    job: Option<PathBuf>,

    /// How many devices are updated at the same time.
    #[arg(long, value_name = "DEVICES", value_parser = number, default_value = "8", hide_short_help = true)]
    at_once: u32,

    /// Whether devices get the same program together, in one download for all of them.
    #[arg(long, value_enum, value_name = "WHEN", default_value = "auto", default_missing_value = "always", num_args = 0..=1, require_equals = true)]
    together: Together,

    /// Write the results to this file as JSON.
    #[arg(long, value_name = "FILE", hide_short_help = true)]
    report: Option<PathBuf>,

    /// The program number: sub-index of 1F50h.
    #[arg(long, short = 'P', value_name = "1..254", value_parser = program_number, default_value = "1",
          conflicts_with = "prog_no")]
    program: u8,

    #[command(flatten)]
    patience: Patience,

    #[command(flatten)]
    source: Source,

    #[command(flatten)]
    labels: Labels,

    /// Compare vendor-ID and product code of file and device before anything is erased.
    #[arg(long)]
    check_target: bool,

    /// Release the program for autostart without a trial. By default, if the dialect has such a
    /// release, the program is started once, its identity (1018h) is compared with the
    /// bootloader's, and it is called back.
    #[arg(long, conflicts_with = "chk_run")]
    no_trial: bool,

    /// Watch the program for this time after each start, in milliseconds; 0 does not watch. By default
    /// 1000, or twice the time of the watchdog that the bootloader starts for it. A second boot-up, an
    /// emergency 6000h or the bootloader ends the update: exit status 7.
    #[arg(long, value_parser = watch_time, value_name = "MS")]
    watch: Option<Duration>,

    /// Search until the bootloader answers or Ctrl-C ends the search: the device may still be
    /// switched off, and an application that does not leave is called again and again.
    #[arg(long)]
    wait: bool,

    /// Continue even if another tool talks to the device, or another coflash process of this
    /// computer works on it.
    #[arg(long, hide_short_help = true)]
    not_alone: bool,

    /// Do not ask a flying NMT master (CiA 302-2) for mastership; by default the tool takes the
    /// mastership during the update of a lift device.
    #[arg(long, hide_short_help = true)]
    no_mastership: bool,

    /// Leave the device in the bootloader, with the program neither tried nor released for
    /// autostart.
    #[arg(long)]
    no_start: bool,

    /// At the very end, compare the program's CRC once more with the CRC that the running program
    /// reports.
    #[arg(long)]
    verify: bool,

    /// Download a sealed image block by block (--block-size) instead of in one transfer.
    #[arg(long = "blocks", hide_short_help = true)]
    in_blocks: bool,

    /// Send everything, also if the device could go on with a download of this file that was cut
    /// off.
    #[arg(long, hide_short_help = true)]
    from_start: bool,

    /// How many times a block is sent again after a CRC error or a broken transfer.
    #[arg(long, value_name = "TIMES", value_parser = number, default_value = "3", hide_short_help = true)]
    block_repeats: u32,

    /// Let the device alone judge the image. By default the tool refuses an image that cannot be a
    /// program of an STM32F4 (vector table, a bootloader, only zeros), and an image for another
    /// device or another place in flash, before it changes the device.
    #[arg(long)]
    force: bool,

    #[command(flatten)]
    access: Access,

    #[command(flatten)]
    machine: Machine,

    #[command(flatten)]
    legacy: Legacy,
}

/// The program for one device.
struct Assignment {
    node: Option<NodeId>,
    address: Option<LssAddress>,
    image: PathBuf,
    file: Payload,
    options: FlashOptions,
}

impl Flash {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        if let Some(list) = self.legacy.list() {
            context.result(&list, || json!({ "list": list }));
            return Ok(());
        }
        self.legacy.check(context)?;
        let package = self.image().filter(|file| is_package(file));
        self.typed.check(package.is_some(), &options())?;
        self.report.as_deref().map_or(Ok(()), output_file::ready)?;
        if let Some(package) = package {
            return self.machine(context, package);
        }
        let devices = match &self.job {
            Some(job) => self.devices_of_job(context, job)?,
            None => self.devices(context)?,
        };
        if devices.iter().any(|device| self.leaves_trial_out(device)) {
            context.out.say(
                "no trial, as DotNetFlashtool makes none: the program is released before its first start \
                 (--chk_run tries it first)",
            );
        }
        let bus = self.bus(context);
        let mut link = context.link_at(bus.as_deref(), self.legacy.bit_rate())?;
        match devices.as_slice() {
            [device] if self.job.is_none() => self.one(context, &mut link, device),
            devices => self.many(context, &mut link, devices),
        }
    }

    /// Updates a machine with a package.
    fn machine(&self, context: &Context, package: &Path) -> Result<(), Failure> {
        let flash = self.common_options().verify(self.verify).together(self.together == Together::Always);
        let given = Given {
            patience: &self.patience,
            bus: self.bus(context),
            bit_rate: self.legacy.bit_rate(),
            flash,
            many: self.many_options()?,
            report: self.report.as_deref(),
            not_alone: self.not_alone,
        };
        self.machine.run(context, package, &given)
    }

    /// The options that mean the same for every file.
    fn common_options(&self) -> FlashOptions {
        FlashOptions::default()
            .repeats(self.block_repeats)
            .watch(self.watch)
            .dialect(self.access.dialect())
            .unlock(self.access.unlock())
            .wait(self.wait)
            .alone(!self.not_alone)
            .mastership(!self.no_mastership)
            .from_start(self.from_start)
    }

    /// The options for several devices.
    fn many_options(&self) -> Result<ManyOptions, Failure> {
        Ok(ManyOptions::default()
            .timing(self.patience.timing())
            .transfers(self.patience.transfers())
            .at_once(self.at_once as usize)
            .together(self.together != Together::Never)
            .cancelled(cancelled()?))
    }

    /// Whether the manual's words leave the trial of this file out. DotNetFlashtool knows neither job
    /// files nor new bootloaders, and a bootloader is never installed without its trial.
    fn is_untried(&self, file: &Payload) -> bool {
        self.legacy.makes_no_trial() && self.job.is_none() && !file.is_bootloader()
    }

    /// Whether that alone is the reason that this program gets no trial.
    fn leaves_trial_out(&self, device: &Assignment) -> bool {
        let has_trial = matches!(self.access.dialect(), None | Some(Dialect::Block));
        self.is_untried(&device.file) && has_trial && !self.no_trial && !self.no_start
    }

    /// The bus, in either spelling.
    fn bus(&self, context: &Context) -> Option<String> {
        context.bus.clone().or_else(|| self.legacy.bus())
    }

    /// The firmware file, in either spelling.
    fn image(&self) -> Option<&Path> {
        self.file.as_deref().or(self.legacy.file())
    }

    /// The program number, in either spelling.
    fn number(&self) -> u8 {
        self.legacy.program().unwrap_or(self.program)
    }

    /// The devices of the command line, which all get the same program.
    fn devices(&self, context: &Context) -> Result<Vec<Assignment>, Failure> {
        let unnamed = || Failure::usage("no firmware file is named", "name the firmware: coflash flash FILE");
        let image = self.image().ok_or_else(unnamed)?;
        let file = self.payload(
            context,
            image,
            self.number(),
            &self.source,
            self.labels.label(image)?,
            self.access.dialect(),
        )?;
        let options = self.options(&file, None)?;
        match &file {
            Payload::Program(program) => {
                let (size, crc) = (program.size(), program.crc());
                context.out.say(format_args!("{}: program of {size} bytes, CRC {crc:08X}h", image.display()));
            }
            Payload::Sealed(file) if file.head().program() != BOOTLOADER => {
                context.out.say(format_args!("{}: {}", image.display(), brief(file)));
            }
            new => {
                let version = new.bootloader().map(|version| version.to_string()).unwrap_or_default();
                let (image, size, crc) = (image.display(), new.size(), new.crc());
                context
                    .out
                    .say(format_args!("{image}: bootloader {version} of {size} bytes, CRC {crc:08X}h"));
            }
        }
        let address = self.legacy.address();
        let mut nodes: Vec<NodeId> = Vec::new();
        for node in self.legacy.nodes().unwrap_or(&self.node).iter().flatten() {
            if !nodes.contains(node) {
                nodes.push(*node);
            }
        }
        if address.is_some() && nodes.len() > 1 {
            let advice = "give one --node, or use a job file with an LSS address for each device";
            return Err(Failure::usage("one LSS address cannot get several node-IDs", advice));
        }
        let assign = |node| Assignment {
            node: Some(node),
            address,
            image: image.to_path_buf(),
            file: file.clone(),
            options,
        };
        Ok(nodes.into_iter().map(assign).collect())
    }

    /// The devices of a job file. Every image is read and checked before any device is changed.
    fn devices_of_job(&self, context: &Context, job: &Path) -> Result<Vec<Assignment>, Failure> {
        // Devices with the same image share it.
        type Known = (PathBuf, Option<String>, u8, Option<Dialect>, Payload);
        let mut known: Vec<Known> = Vec::new();
        let mut devices = Vec::new();
        let recipe = read_recipe(job)?;
        for device in recipe.devices().map_err(|fault| Failure::recipe(job, &fault))? {
            let row = device.row;
            let dialect = device.dialect.or(self.access.dialect());
            let (image, program) = (row.image.clone(), row.program.unwrap_or(self.number()));
            let same = known.iter().find(|(path, board, number, dialect_of, _)| {
                (path, board, *number, *dialect_of) == (&image, &row.board, program, dialect)
            });
            let file = match same {
                Some((.., file)) => file.clone(),
                None => {
                    let source = match &row.board {
                        Some(board) => self.source.for_board(board),
                        None => self.source.clone(),
                    };
                    let file = self.payload(context, &image, program, &source, Label::default(), dialect)?;
                    known.push((image.clone(), row.board.clone(), program, dialect, file.clone()));
                    file
                }
            };
            let options = self.options(&file, Some(&device))?.program(program).dialect(dialect);
            let (node, address) = (device.node, device.address);
            devices.push(Assignment { node, address, image, file, options });
        }
        Ok(devices)
    }

    /// Reads and checks what a device is to get.
    fn payload(
        &self,
        context: &Context,
        path: &Path,
        program: u8,
        source: &Source,
        label: Label,
        dialect: Option<Dialect>,
    ) -> Result<Payload, Failure> {
        let judging = if self.force { Judging::Nothing } else { Judging::Whole };
        let reading = source.reading(program, label)?.dialect(dialect).judging(judging);
        let loaded = reading.read(path, &bytes(path)?).map_err(|fault| Failure::content(path, fault))?;
        warn(context, path, &loaded.notes, loaded.left_out);
        let in_blocks = self.in_blocks && !loaded.payload.is_bootloader();
        if let (Payload::Sealed(file), true) = (&loaded.payload, in_blocks) {
            // The device reports the program's start address later; this checks now whether such blocks
            // are possible.
            blocks_of_sealed(file, 0, source.block_size()).map_err(|error| Failure::convert(error, path))?;
        }
        Ok(loaded.payload)
    }

    /// The options of the command line, unless the row of a job replaces them.
    fn options(&self, file: &Payload, device: Option<&RecipeDevice<'_>>) -> Result<FlashOptions, Failure> {
        let row = device.map(|device| device.row);
        let check = row.and_then(|row| row.check_target);
        let check = check.unwrap_or(self.check_target || self.legacy.check_target());
        let advice = "convert it with --vid and --pid, or give these options here";
        let unnamed = || Failure::usage("the file does not name its target device", advice);
        let named = row.and_then(Row::target);
        let of_file = if check { Some(file.target().ok_or_else(unnamed)?) } else { None };
        let trial = row.and_then(|row| row.trial_run);
        let trial = trial.unwrap_or(!(self.no_trial || self.is_untried(file)));
        let start = row.and_then(|row| row.start).unwrap_or(!self.no_start);
        if file.is_bootloader() && !(trial && start) {
            let advice =
                "leave out --no-trial and --no-start: without its trial a bootloader is not installed";
            return Err(Failure::usage("a new bootloader is tried before it replaces the old one", advice));
        }
        Ok(self
            .common_options()
            .program(self.number())
            .check_target(named.or(of_file))
            .trial_run(trial)
            .start(start)
            .verify(row.and_then(|row| row.verify).unwrap_or(self.verify))
            .blocks(self.in_blocks.then(|| self.source.block_size()))
            .joined_blocks(self.source.joined_blocks())
            .force(self.force))
    }

    /// The node-ID of a device. A device named by its LSS address gets its node-ID first.
    fn node_of(&self, link: &mut Link, device: &Assignment) -> Result<NodeId, Failure> {
        match (device.address, device.node) {
            (Some(address), node) => {
                let Link::Bus(adapter) = link else {
                    let advice = "name the device by its node-ID, or connect to its CAN bus with an adapter";
                    return Err(Failure::usage(
                        "a device behind a gateway cannot be named by its LSS address",
                        advice,
                    ));
                };
                let boot = self.patience.timing().boot;
                Ok(ensure_node_id(&mut **adapter, &address, node, boot, &cancelled()?)?)
            }
            (None, Some(node)) => Ok(node),
            // A job with neither was refused earlier.
            (None, None) => Err(Failure::usage("a device has no node-ID", "give it one")),
        }
    }

    /// Locks the node, so that no other process of this computer works on it.
    fn lock(&self, context: &Context, node: NodeId) -> Result<Option<Lock>, Failure> {
        if self.not_alone {
            Ok(None)
        } else {
            context.lock(self.bus(context).as_deref(), node).map(Some)
        }
    }

    fn one(&self, context: &Context, link: &mut Link, device: &Assignment) -> Result<(), Failure> {
        let node = self.node_of(link, device)?;
        let _lock = self.lock(context, node)?;
        begin(&json!([{ "node": node.get(), "image": device.image }]), self.report.as_deref())?;
        let mut session = self.patience.session(link, node)?;
        let mut progress = Progress::new(context.out, node);
        let mut left = None;
        let result = flash(&mut session, &device.file, &device.options, &mut |event| match event {
            Event::Done(done) => {
                left = Some(done.left);
                progress.show(Event::Done(done));
            }
            event => progress.show(event),
        });
        progress.finish();
        let waiting = result.is_err().then(|| context.waiting("the bus has been observed"));
        let result = result.map_err(|error| Failure::diagnosed(error, &mut session).leaving(left));
        drop(waiting);
        let (name, image) = (format!("node {node}"), device.image.display().to_string());
        let outcome = Outcome { node: Some(node), name, image, result };
        let write = |path| write_report(path, &document(std::slice::from_ref(&outcome)));
        let written = self.report.as_deref().map_or(Ok(()), write);
        let report = outcome.result?;
        let mut value = json!(report);
        value["node"] = node.get().into();
        value["program"] = report.renewal.map_or(device.options.program, |renewal| renewal.number).into();
        let written = written.map_err(|failure| failure.within(&mut value));
        context.result(report, || value);
        written
    }

    fn many(&self, context: &Context, link: &mut Link, devices: &[Assignment]) -> Result<(), Failure> {
        if self.together == Together::Always && matches!(link, Link::Gateway(_)) {
            let advice = "leave out --together, or use an adapter on the bus";
            return Err(Failure::usage("a gateway does one transfer at a time", advice));
        }
        let mut outcomes: Vec<Option<Outcome>> = Vec::new();
        let mut jobs: Vec<(usize, Job)> = Vec::new();
        let mut locks = Vec::new();
        for (number, device) in devices.iter().enumerate() {
            let image = device.image.display().to_string();
            let twice = |node| jobs.iter().any(|(_, job): &(usize, Job)| job.node == node);
            let mut node = device.node;
            let begun = self.node_of(link, device).and_then(|own| {
                node = Some(own);
                if twice(own) {
                    let advice = "name each device once, and give each its own node-ID";
                    return Err(Failure::usage(format!("node {own} is in the job twice"), advice));
                }
                Ok((own, self.lock(context, own)?))
            });
            outcomes.push(match begun {
                Ok((node, lock)) => {
                    locks.push(lock);
                    let options = device.options.together(self.together == Together::Always);
                    jobs.push((number, Job::new(node, device.file.clone(), options)));
                    None
                }
                Err(failure) => Some(Outcome { node, name: device.name(), image, result: Err(failure) }),
            });
        }
        let options = self.many_options()?;
        let (numbers, jobs): (Vec<usize>, Vec<Job>) = jobs.into_iter().unzip();
        let nodes: Vec<NodeId> = jobs.iter().map(|job| job.node).collect();
        let begun = numbers.iter().zip(&nodes);
        let begun =
            begun.map(|(number, node)| json!({ "node": node.get(), "image": devices[*number].image }));
        begin(&begun.collect(), self.report.as_deref())?;
        let board = Board::new(context.out, &nodes);
        let show = |job, event| board.show(job, event);
        let results = match link {
            Link::Bus(adapter) => flash_many(&mut **adapter, &jobs, &options, &show),
            Link::Gateway(gateway) => flash_in_turn(&mut **gateway, &jobs, &options, &show),
        };
        board.finish();
        let waiting =
            results.iter().any(Result::is_err).then(|| context.waiting("the bus has been observed"));
        let diagnosis = match nodes.first() {
            Some(node) => diagnose_silence(&mut self.patience.session(link, *node)?, &results),
            None => None,
        };
        drop(waiting);
        for ((number, node), result) in numbers.into_iter().zip(nodes).zip(results) {
            let image = devices[number].image.display().to_string();
            outcomes[number] = Some(Outcome::new(node, image, result, diagnosis.as_ref()));
        }
        let outcomes: Vec<Outcome> = outcomes.into_iter().flatten().collect();
        summary(context.out, &outcomes, self.report.as_deref())
    }
}

/// A summary of a sealed image before the download.
fn brief(file: &SealedFile) -> String {
    let head = file.head();
    let names: Vec<&str> = flags(head.flags()).collect();
    let kind = if names.is_empty() { String::new() } else { format!(" ({})", names.join(", ")) };
    let keys: Vec<String> = file.parts().signers().into_iter().map(|id| format!("{id:08X}h")).collect();
    format!(
        "sealed program of {} bytes{kind}, CRC {:08X}h, version {}, counter {}, signed by {}",
        head.size(),
        head.crc(),
        ProgramVersion(head.version()),
        head.counter(),
        keys.join(", ")
    )
}

impl Assignment {
    /// The device's name in messages.
    fn name(&self) -> String {
        match (self.node, self.address) {
            (Some(node), _) => format!("node {node}"),
            (None, Some(address)) => format!("device with serial number {:08X}h", address.serial_number),
            (None, None) => "device".to_string(),
        }
    }
}

/// The command with its options.
pub(super) fn options() -> Command {
    Flash::augment_args(Command::new("flash"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::package::{beside_packages, FOR_PACKAGES};

    /// An option of `flash` that is not in the list is refused beside a package.
    #[test]
    fn the_options_beside_a_package_are_options_of_flash() {
        let flash = options();
        for id in beside_packages().chain(FOR_PACKAGES.map(|(id, _)| id)) {
            assert!(flash.get_arguments().any(|argument| argument.get_id() == id), "{id}");
        }
    }
}
