//! `coflash package`, and the update of a machine with a package: `coflash flash machine.cpk`.

use std::collections::BTreeMap;
use std::io::{self, BufRead as _, IsTerminal as _, Write as _};
use std::path::{Path, PathBuf};

use canopen::NodeId;
use clap::parser::ValueSource;
use clap::{Arg, ArgMatches, Args, Command, FromArgMatches};
use coboot_can::Link;
use coflash_core::device::lock::Lock;
use coflash_core::device::scan::ScanOptions;
use coflash_core::file::inspect::Date;
use coflash_core::file::limit;
use coflash_core::machine::{
    self, kind, version, Bad, DeviceFault, Good, Outcome, Package, Plan, PlanError, Recipe, RunOptions,
    Signer, Todo,
};
use coflash_core::update::many::ManyOptions;
use coflash_core::update::FlashOptions;
use seal::wire::CERTIFICATE;
use serde_json::{json, Value};

use super::context::Context;
use super::device::{asked, cancelled, Patience};
use super::file::front;
use super::file::same_file;
use super::many::{begin, end, Board};
use super::output::Failure;
use super::output_file;
use super::record;
use super::seal::keys::{self, public_key, signing_key};

/// Makes one file with the programs of a machine.
///
/// Such a package has the programs of several types of nodes.
///
/// The recipe says which firmware file is for which nodes, in the order of the update. Each file is
/// read, checked and converted as by flash. The same input gives the same output, byte for byte.
#[derive(Debug, Args)]
pub(super) struct MakePackage {
    /// The recipe (see the manual).
    #[arg(value_name = "RECIPE")]
    recipe: PathBuf,

    /// The package to write; by default the recipe's name with .cpk.
    #[arg(long, short, value_name = "OUT")]
    output: Option<PathBuf>,

    /// Sign the package with this private key; give the option once for each key, three at most.
    #[arg(long, value_name = "FILE")]
    key: Vec<PathBuf>,

    /// The certificate of a key; a key without one is a root.
    #[arg(long, value_name = "FILE", requires = "key")]
    cert: Vec<PathBuf>,
}

impl MakePackage {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        let path = &self.recipe;
        let recipe = read_recipe(path)?;
        let parts = recipe.parts().map_err(|fault| Failure::recipe(path, &fault))?;
        let keys = self.key.iter().map(|path| signing_key(path)).collect::<Result<Vec<_>, _>>()?;
        let certificates =
            self.cert.iter().map(|path| keys::certificate(path)).collect::<Result<Vec<_>, _>>()?;
        let of = |certificate: &[u8; CERTIFICATE]| seal::wire::Certificate(certificate).key();
        let is_second = |(at, one): (usize, &_)| certificates[..at].iter().any(|other| of(other) == of(one));
        if certificates.iter().enumerate().any(is_second) {
            let advice = "give each key one certificate, and --cert once for it";
            return Err(Failure::usage("two certificates belong to one key", advice));
        }
        let pairs: Vec<_> = keys
            .iter()
            .map(|key| (key, certificates.iter().find(|one| of(one) == key.public().bytes()).copied()))
            .collect();
        let is_used =
            |certificate: &&[u8; CERTIFICATE]| pairs.iter().any(|(_, one)| one.as_ref() == Some(certificate));
        if !certificates.iter().all(|certificate| is_used(&certificate)) {
            let advice = "give each certificate with its key";
            return Err(Failure::usage("a certificate belongs to none of the keys", advice));
        }
        let bytes = machine::make(recipe.name, recipe.release, &parts, &pairs)
            .map_err(|fault| Failure::package(path, &fault))?;
        let output = self.output.clone().unwrap_or_else(|| path.with_extension("cpk"));
        let advice = "name the package with --output";
        if same_file(&output, path) {
            return Err(Failure::usage("the package would replace its recipe", advice));
        }
        if recipe.programs.iter().any(|row| same_file(&output, &row.image)) {
            return Err(Failure::usage("the package would replace an image of its recipe", advice));
        }
        output_file::write(&output, &bytes)?;
        let package = Package::parse(&bytes).map_err(|fault| Failure::package(&output, &fault))?;
        show(context, &output, &Checked { package, known: None });
        Ok(())
    }
}

/// Reads a recipe, or a job file, which is one.
pub(super) fn read_recipe(path: &Path) -> Result<Recipe, Failure> {
    let text = limit::read_text(path).map_err(|error| Failure::unreadable(path, &error))?;
    let folder = path.parent().unwrap_or(Path::new(""));
    Recipe::parse(&text, folder).map_err(|fault| Failure::recipe(path, &fault))
}

/// Whether a file is one for a machine.
pub(super) fn is_package(path: &Path) -> bool {
    machine::is_package(path, &front(path, machine::FRONT))
}

/// A package, and which of its signers belong to the roots that the user has named, if any was named.
pub(super) struct Checked {
    pub(super) package: Package,
    pub(super) known: Option<Vec<Signer>>,
}

/// Reads and checks a package.
pub(super) fn read(path: &Path, trusted: &Trusted) -> Result<Checked, Failure> {
    let roots = trusted.trust.iter().map(|path| public_key(path)).collect::<Result<Vec<_>, _>>()?;
    let package =
        Package::parse(&super::file::bytes(path)?).map_err(|fault| Failure::package(path, &fault))?;
    let known = match roots.as_slice() {
        [] => None,
        roots => Some(package.trust(roots).map_err(|fault| Failure::package(path, &fault))?),
    };
    Ok(Checked { package, known })
}

/// Shows a package, for `inspect`.
pub(super) fn inspect(context: &Context, path: &Path, trusted: &Trusted) -> Result<(), Failure> {
    show(context, path, &read(path, trusted)?);
    Ok(())
}

/// The roots that may sign packages.
#[derive(Debug, Args)]
pub(super) struct Trusted {
    /// Take a package only if this root has signed it or certified its signer (public key); give the
    /// option once for each root.
    #[arg(long, value_name = "FILE")]
    pub(super) trust: Vec<PathBuf>,
}

/// Shows what is in a package.
fn show(context: &Context, path: &Path, checked: &Checked) {
    let Checked { package, known } = checked;
    let manifest = package.manifest();
    let mut words = format!("{}: package for a machine", path.display());
    for text in [&manifest.name, &manifest.release].into_iter().flatten() {
        words += &format!(", {text}");
    }
    if let Some(date) = package.date() {
        words += &format!(", newest program of {}", Date(date));
    }
    words += "\n";
    for (entry, program) in package.programs() {
        let version = version(program).map_or(String::new(), |version| format!(", version {version}"));
        let count = entry.count.map_or(String::new(), |count| format!(", {count} devices"));
        let number = if entry.is_bootloader() { String::new() } else { format!(" {}", entry.program) };
        words += &format!(
            "  {}: {}{number} of {} bytes{version}, for {}{count}\n",
            entry.name,
            kind(program),
            program.size(),
            entry.whom()
        );
    }
    for line in checked.signers() {
        words += &format!("  {line}\n");
    }
    context.result(words, || {
        let program = |(entry, program): (&machine::Entry, &coflash_core::update::Payload)| {
            let mut value = json!(entry);
            value["kind"] = kind(program).into();
            value["version"] = version(program).into();
            value["program_size"] = program.size().into();
            value["crc"] = program.crc().into();
            value
        };
        json!({
            "format": "package",
            "output": path.display().to_string(),
            "name": manifest.name,
            "release": manifest.release,
            "date": package.date(),
            "programs": package.programs().map(program).collect::<Vec<_>>(),
            "signers": package.signers().iter().map(|signer| json!({
                "key": signer.key,
                "root": signer.certificate().map(|certificate| certificate.root_id()),
                "trusted": known.as_ref().is_some_and(|known| known.contains(signer)),
            })).collect::<Vec<_>>(),
            "trusted": known.is_some(),
        })
    });
}

impl Checked {
    /// Who has signed it, a line for each.
    pub(super) fn signers(&self) -> Vec<String> {
        let line = |signer: &Signer| {
            let whose = match signer.certificate() {
                Some(certificate) => format!("certified by root {:08X}h", certificate.root_id()),
                None => "which is a root".to_owned(),
            };
            let key = format!("key {:08X}h, {whose}", signer.key);
            match &self.known {
                None => format!("signed by {key}; give --trust with the root to check that"),
                Some(known) if known.contains(signer) => format!("signed by {key}"),
                Some(_) => format!("not checked: another root: {key}"),
            }
        };
        match self.package.signers() {
            [] => vec!["not signed".to_owned()],
            signers => signers.iter().map(line).collect(),
        }
    }
}

/// The options of `flash` that do beside a package what they do beside another file. A package has values
/// for the others.
const BESIDE_PACKAGES: [&str; 3] = [
    // What is done, and where it is said.
    "file legacy_file job report at_once together from_start block_repeats verify watch wait not_alone \
     no_mastership dialect unlock",
    // Time limits and transfers.
    "boot_timeout command_timeout delay repeats sdo_attempts sdo_timeout segmented silence_timeout",
    // The bus; what is ignored or refused for any file is said for a package, too.
    "baudrate index vxd_type device_no ip_addr ip_port gateway_id network_id",
];

/// Each of them.
pub(super) fn beside_packages() -> impl Iterator<Item = &'static str> {
    BESIDE_PACKAGES.iter().flat_map(|ids| ids.split(' '))
}

/// The options for packages alone, and what they would do.
pub(super) const FOR_PACKAGES: [(&str, &str); 3] = [
    ("yes", "only the update with a package is confirmed"),
    ("trust", "only the signers of a package are compared with --trust"),
    ("allow_older", "only the programs of a package are not written where the device has a newer one"),
];

/// The options that a user has typed: a default, also one of the configuration, contradicts nothing.
#[derive(Clone, Debug, Default)]
pub(super) struct Typed(Vec<String>);

impl Typed {
    /// Refuses an option that means nothing for a package, or for any other file. `flash` is the command
    /// with its options.
    pub(super) fn check(&self, is_package: bool, flash: &Command) -> Result<(), Failure> {
        let is_typed = |id: &str| self.0.iter().any(|typed| typed == id);
        let mut alone = FOR_PACKAGES.iter().filter(|(id, _)| is_typed(id));
        if let (false, Some((_, what))) = (is_package, alone.next()) {
            let advice =
                "leave --yes, --trust and --allow-older out, or name a package that coflash package made";
            return Err(Failure::usage(*what, advice));
        }
        let is_free = |id: &str| {
            beside_packages().any(|free| free == id) || FOR_PACKAGES.iter().any(|(alone, _)| *alone == id)
        };
        let refused =
            |option: &&Arg| is_typed(option.get_id().as_str()) && !is_free(option.get_id().as_str());
        let option = flash
            .get_arguments()
            .filter(|_| is_package)
            .find(refused)
            .map(|option| option.get_long().unwrap_or_else(|| option.get_id().as_str()));
        let Some(option) = option else { return Ok(()) };
        let advice = "leave it out: the package says which device gets which program";
        Err(Failure::usage(format!("--{option} has no meaning beside a package"), advice))
    }
}

impl FromArgMatches for Typed {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        // Groups have no source.
        let is_typed = |id: &&clap::Id| {
            matches.try_contains_id(id.as_str()).is_ok()
                && matches.value_source(id.as_str()) == Some(ValueSource::CommandLine)
        };
        Ok(Self(matches.ids().filter(is_typed).map(ToString::to_string).collect()))
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

impl Args for Typed {
    fn augment_args(command: Command) -> Command {
        command
    }

    fn augment_args_for_update(command: Command) -> Command {
        command
    }
}

/// The options of `flash` for a package alone.
#[derive(Debug, Args)]
pub(super) struct Machine {
    #[command(flatten)]
    trusted: Trusted,

    /// Carry out the plan of a package without asking.
    #[arg(long, short)]
    yes: bool,

    /// Also write programs of a package that are older than those of the devices.
    #[arg(long)]
    allow_older: bool,
}

/// What an update with a package takes from the other options.
pub(super) struct Given<'a> {
    pub(super) patience: &'a Patience,
    /// The bus, and its bit rate if the URL has none.
    pub(super) bus: Option<String>,
    pub(super) bit_rate: Option<u32>,
    pub(super) flash: FlashOptions,
    pub(super) many: ManyOptions,
    pub(super) report: Option<&'a Path>,
    /// Continue beside another process.
    pub(super) not_alone: bool,
}

impl Machine {
    /// Updates the machine: scan, plan, confirmation, and the run.
    pub(super) fn run(&self, context: &Context, path: &Path, given: &Given<'_>) -> Result<(), Failure> {
        let out = context.out;
        let checked = read(path, &self.trusted)?;
        checked.signers().iter().for_each(|line| out.say(line));
        if let Some(date) = checked.package.date() {
            out.say(format_args!("its newest program is of {}", Date(date)));
        }
        let package = checked.package;
        let Link::Bus(mut adapter) = context.link_at(given.bus.as_deref(), given.bit_rate)? else {
            let advice = "connect to the bus of the machine with an adapter";
            return Err(Failure::usage(
                "a gateway cannot search the bus for the devices of a package",
                advice,
            ));
        };
        let flag = cancelled()?;
        // Before the scan, which ends the transfers of all nodes. The others are known after it.
        let mut locks = BTreeMap::new();
        let url = context.url(given.bus.as_deref())?;
        Lock::more(&url, package.nodes().filter(|_| !given.not_alone), &mut locks)?;
        let waiting = context.waiting("all nodes were asked, and had time to answer");
        let scan = ScanOptions::default().timing(given.patience.timing()).alone(!given.not_alone);
        let mut plan = machine::plan(&mut *adapter, &package, &scan, &flag).map_err(|error| match error {
            PlanError::Bus(error) => Failure::from(error),
            PlanError::Package(fault) => Failure::package(path, &fault),
        })?;
        drop(waiting);
        if self.allow_older {
            plan.allow_older(|_| true);
        }
        out.say(plan.to_string().trim_end());
        if plan.updates() > 0 {
            self.confirm(context, &plan)?;
        }
        Lock::more(&url, plan.nodes().filter(|_| !given.not_alone), &mut locks)?;
        let before = record::before(given.report);
        begin(&begun(&plan), given.report)?;
        let nodes: Vec<NodeId> = plan.nodes().collect();
        let board = Board::new(out, &nodes);
        let show = |node: NodeId, _, event| {
            if let Some(at) = nodes.iter().position(|other| *other == node) {
                board.show(at, event);
            }
        };
        let options = RunOptions::default().flash(given.flash).many(given.many.clone());
        let outcomes = machine::run(&mut *adapter, &package, &plan, &options, &show);
        board.finish();
        summary(context, path, &package, &plan, outcomes, (&before, given.report))
    }

    /// Asks the user for the start.
    fn confirm(&self, context: &Context, plan: &Plan) -> Result<(), Failure> {
        if self.yes {
            return Ok(());
        }
        if !context.out.for_people() || !io::stdin().is_terminal() {
            let advice = "look at the plan, and run the command again with --yes";
            return Err(Failure::usage("nobody can confirm the plan here, and nothing was changed", advice));
        }
        let count = plan.updates();
        let what = if count == 1 { "1 program".to_owned() } else { format!("{count} programs") };
        let _ = write!(io::stderr(), "Write {what}? [y/N] ");
        let mut line = String::new();
        let _ = asked(|| io::stdin().lock().read_line(&mut line))?;
        match line.trim().to_ascii_lowercase().as_str() {
            "y" | "yes" => Ok(()),
            _ => Err(Failure::from(coflash_core::Error::Cancelled)),
        }
    }
}

/// What a plan is about to write.
fn begun(plan: &Plan) -> Value {
    let steps = plan.devices.iter().flat_map(|device| device.steps.iter().map(move |step| (device, step)));
    let due = steps.filter(|(_, step)| step.todo == Todo::Update);
    due.map(|(device, step)| {
        let (node, serial, program) = (device.node.get(), device.identity[3], &step.program);
        json!({ "node": node, "serial_number": serial, "program": program, "from": step.from, "to": step.to })
    })
    .collect()
}

/// Shows the outcome of each program of each device; the result of the command. `before` are the
/// runs before this one.
fn summary(
    context: &Context,
    path: &Path,
    package: &Package,
    plan: &Plan,
    outcomes: Vec<Outcome>,
    (before, report): (&[Value], Option<&Path>),
) -> Result<(), Failure> {
    let out = context.out;
    let (mut failures, mut devices) = (Vec::new(), Vec::new());
    out.say("");
    let all = outcomes.len();
    for Outcome { node, entry, result, .. } in outcomes {
        let Some((program, _)) = package.programs().nth(entry) else { continue };
        let whom = node.map_or_else(|| "machine".to_owned(), |node| format!("node {node}"));
        let (name, image) = (&program.name, &program.file);
        let mut value = json!({ "name": whom, "program": name, "image": image, "ok": result.is_ok() });
        value["node"] = json!(node.map(NodeId::get));
        let device = plan.devices.iter().find(|device| Some(device.node) == node);
        let step = device.and_then(|device| device.steps.iter().find(|step| step.entry == entry));
        if let Some((device, step)) = device.zip(step) {
            value["serial_number"] = json!(device.identity[3]);
            (value["from"], value["to"]) = (json!(step.from), json!(step.to));
            value["every_version_has_this_crc"] = step.every_version_has_this_crc.into();
        }
        let (state, words) = match result {
            Ok(Good::Had) => match record::unended(&value, before) {
                None => ("had", "it had this program".to_owned()),
                Some(began) => {
                    let update = format!("the update that began at {began} and did not end");
                    ("resumed", format!("it has this program from {update}"))
                }
            },
            Ok(Good::Updated(report)) => {
                value["report"] = json!(report);
                ("updated", report.to_string())
            }
            Err(bad) => {
                let is_older = matches!(bad, Bad::Left(DeviceFault::Older { .. }));
                let failure = match bad {
                    Bad::Left(fault) => Failure::of_device(&fault),
                    Bad::Failed(failed) => Failure::from(failed.error).leaving(Some(failed.left)),
                };
                value["error"] = failure.value()["error"].take();
                let words = failure.to_string().trim_end().to_owned();
                failures.push(failure);
                (if is_older { "older" } else { "failed" }, words)
            }
        };
        // Of another machine, the plan has said it.
        if state != "failed" || !plan.is_of_other_machine() {
            out.say(format_args!("{whom}: {name}: {words}"));
        }
        value["state"] = state.into();
        devices.push(value);
    }
    out.say(format_args!("{} of {all} programs are in their devices", all - failures.len()));
    let failed = devices.iter().filter(|value| value["state"] == "failed").count();
    let mut document = json!({ "command": "flash", "devices": devices, "failed": failed });
    (document["package"], document["foreign"]) = (path.display().to_string().into(), json!(plan.foreign));
    let result = match all {
        0 => Err(Failure::no_device_for(path).within(&mut document)),
        _ => Failure::of_programs(&failures.iter().collect::<Vec<_>>(), all),
    };
    end(out, &mut document, report, result)
}
