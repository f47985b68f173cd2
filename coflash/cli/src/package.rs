//! `coflash package`, and the update of a machine with a package: `coflash flash machine.cpk`.

use std::collections::btree_map::Entry;
use std::collections::BTreeMap;
use std::io::{self, BufRead as _, IsTerminal as _, Read as _, Write as _};
use std::path::{Path, PathBuf};

use canopen::NodeId;
use clap::parser::ValueSource;
use clap::{ArgMatches, Args, Command, FromArgMatches};
use coboot_can::Link;
use coflash_core::device::lock::Lock;
use coflash_core::device::scan::ScanOptions;
use coflash_core::file::limit;
use coflash_core::machine::{
    self, kind, version, Bad, Good, Outcome, Package, Plan, PlanError, Recipe, RunOptions, Signer,
};
use coflash_core::update::many::ManyOptions;
use coflash_core::update::FlashOptions;
use seal::wire::CERTIFICATE;
use serde_json::{json, Value};

use super::context::Context;
use super::device::{cancelled, Patience};
use super::keys::{self, public_key, signing_key};
use super::many::{write_report, Board};
use super::output::{Exit, Failure};
use super::output_file;

/// Makes a package for a machine: one file with the programs of several types of nodes.
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
        let text = limit::read_text(path).map_err(|error| Failure::unreadable(path, &error))?;
        let wrong = |fault| Failure::recipe(path, &fault);
        let recipe = Recipe::parse(&text, path.parent().unwrap_or(Path::new(""))).map_err(wrong)?;
        let parts = recipe.parts().map_err(wrong)?;
        let keys = self.key.iter().map(|path| signing_key(path)).collect::<Result<Vec<_>, _>>()?;
        let certificates =
            self.cert.iter().map(|path| keys::certificate(path)).collect::<Result<Vec<_>, _>>()?;
        let of = |certificate: &[u8; CERTIFICATE]| seal::wire::Certificate(certificate).key();
        let mut rest = certificates.as_slice();
        while let Some(first) = rest.split_off_first() {
            if rest.iter().any(|other| of(other) == of(first)) {
                let advice = "give each key one certificate, and --cert once for it";
                return Err(Failure::usage("two certificates belong to one key", advice));
            }
        }
        let pairs: Vec<_> = keys
            .iter()
            .map(|key| (key, certificates.iter().find(|its| of(its) == key.public().bytes()).copied()))
            .collect();
        let is_used =
            |certificate: &&[u8; CERTIFICATE]| pairs.iter().any(|(_, its)| its.as_ref() == Some(certificate));
        if !certificates.iter().all(|certificate| is_used(&certificate)) {
            let advice = "give each certificate with its key";
            return Err(Failure::usage("a certificate belongs to none of the keys", advice));
        }
        let bytes = machine::make(recipe.name, recipe.release, &parts, &pairs)
            .map_err(|fault| Failure::package(path, &fault))?;
        let output = self.output.clone().unwrap_or_else(|| path.with_extension("cpk"));
        let advice = "name the package with --output";
        if is_same(&output, path) {
            return Err(Failure::usage("the package would replace its recipe", advice));
        }
        if recipe.programs.iter().any(|row| is_same(&output, &row.image)) {
            return Err(Failure::usage("the package would replace an image of its recipe", advice));
        }
        output_file::write(&output, &bytes)?;
        let package = Package::parse(&bytes).map_err(|fault| Failure::package(&output, &fault))?;
        show(context, "package", &output, &Checked { package, known: None });
        Ok(())
    }
}

/// Whether two paths lead to one file, which there is.
fn is_same(one: &Path, other: &Path) -> bool {
    let real = |path: &Path| path.canonicalize().ok();
    real(one).is_some_and(|one| real(other) == Some(one))
}

/// Whether a file is one for a machine.
pub(super) fn is_package(path: &Path) -> bool {
    let is_file = std::fs::metadata(path).is_ok_and(|told| told.is_file());
    let mut front = Vec::new();
    let mut read = |file: std::fs::File| file.take(machine::FRONT as u64).read_to_end(&mut front);
    let is_read = is_file && std::fs::File::open(path).and_then(&mut read).is_ok();
    machine::is_package(path, if is_read { &front } else { &[] })
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
    show(context, "inspect", path, &read(path, trusted)?);
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
fn show(context: &Context, command: &str, path: &Path, checked: &Checked) {
    let Checked { package, known } = checked;
    let manifest = package.manifest();
    let mut words = format!("{}: package for a machine", path.display());
    for text in [&manifest.name, &manifest.release].into_iter().flatten() {
        words += &format!(", {text}");
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
    context.out.result(words, || {
        let program = |(entry, program): (&machine::Entry, &coflash_core::update::Payload)| {
            let mut value = json!(entry);
            value["kind"] = kind(program).into();
            value["version"] = version(program).into();
            value["program_size"] = program.size().into();
            value["crc"] = program.crc().into();
            value
        };
        json!({
            "command": command,
            "format": "package",
            "output": path.display().to_string(),
            "name": manifest.name,
            "release": manifest.release,
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

/// The options of `flash` that a package has values for.
const OF_PACKAGES: [(&str, &str); 30] = [
    ("node", "--node"),
    ("node_id", "--node_id"),
    ("program", "--program"),
    ("prog_no", "--prog_no"),
    ("serial", "--ser_num"),
    ("revision", "--rev"),
    ("product", "--pcode"),
    ("vendor", "--vendor"),
    ("board", "--board"),
    ("start_address", "--start-address"),
    ("end_address", "--end-address"),
    ("adjust_start", "--adjust-start"),
    ("format", "--input-format"),
    ("block_size", "--block-size"),
    ("gap_fill", "--gap-fill"),
    ("block_max_gap", "--block-max-gap"),
    ("crc16", "--crc16"),
    ("last_block_2008", "--last-block-2008"),
    ("vid", "--vid"),
    ("pid", "--pid"),
    ("ver", "--ver"),
    ("date", "--date"),
    ("no_label", "--no-label"),
    ("check_target", "--check-target"),
    ("chk_tgt", "--chk_tgt"),
    ("chk_run", "--chk_run"),
    ("no_trial", "--no-trial"),
    ("no_start", "--no-start"),
    ("in_blocks", "--blocks"),
    ("force", "--force"),
];

/// The options for packages alone, and what they would do.
const FOR_PACKAGES: [(&str, &str); 2] = [
    ("yes", "only the update with a package is confirmed"),
    ("trust", "only the signers of a package are compared with --trust"),
];

/// Which options a user has typed: a default, also one of the configuration, contradicts nothing.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Typed {
    /// The first one that has no meaning beside a package.
    beside_package: Option<&'static str>,
    /// What the first one that is for packages alone would do.
    for_package: Option<&'static str>,
}

impl Typed {
    /// Refuses an option that means nothing for a package, or for any other file.
    pub(super) fn check(self, is_package: bool) -> Result<(), Failure> {
        if let Some(what) = self.for_package.filter(|_| !is_package) {
            let advice = "leave --yes and --trust out, or name a package that coflash package made";
            return Err(Failure::usage(what, advice));
        }
        let Some(option) = self.beside_package.filter(|_| is_package) else { return Ok(()) };
        let advice = "leave it out: the package says which device gets which program";
        Err(Failure::usage(format!("{option} has no meaning beside a package"), advice))
    }
}

impl FromArgMatches for Typed {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        // A command need not have all of them.
        let is_typed = |id: &str| {
            matches.try_contains_id(id).is_ok() && matches.value_source(id) == Some(ValueSource::CommandLine)
        };
        let first = |of: &[(&str, &'static str)]| of.iter().find(|(id, _)| is_typed(id)).map(|its| its.1);
        Ok(Self { beside_package: first(&OF_PACKAGES), for_package: first(&FOR_PACKAGES) })
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

impl Given<'_> {
    /// Locks these nodes too, unless the user has said that others do not matter.
    fn lock(
        &self,
        context: &Context,
        nodes: impl Iterator<Item = NodeId>,
        locks: &mut BTreeMap<NodeId, Lock>,
    ) -> Result<(), Failure> {
        for node in nodes.filter(|_| !self.not_alone) {
            if let Entry::Vacant(free) = locks.entry(node) {
                free.insert(context.lock(self.bus.as_deref(), node)?);
            }
        }
        Ok(())
    }
}

impl Machine {
    /// Updates the machine: scan, plan, confirmation, and the run.
    pub(super) fn run(&self, context: &Context, path: &Path, given: &Given<'_>) -> Result<(), Failure> {
        let out = context.out;
        let checked = read(path, &self.trusted)?;
        checked.signers().iter().for_each(|line| out.say(line));
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
        let named = package.programs().flat_map(|(entry, _)| &entry.nodes);
        given.lock(context, named.filter_map(|node| NodeId::new(*node)), &mut locks)?;
        let waiting = context.waiting("all nodes were asked, and had time to answer");
        let scan = ScanOptions::default().timing(given.patience.timing()).alone(!given.not_alone);
        let plan = machine::plan(&mut *adapter, &package, &scan, &flag).map_err(|error| match error {
            PlanError::Bus(error) => Failure::from(error),
            PlanError::Package(fault) => Failure::package(path, &fault),
        })?;
        drop(waiting);
        out.say(plan.to_string().trim_end());
        if plan.updates() > 0 {
            self.confirm(context, &plan)?;
        }
        given.lock(context, plan.nodes(), &mut locks)?;
        let nodes: Vec<NodeId> = plan.nodes().collect();
        let board = Board::new(out, &nodes);
        let show = |node: NodeId, _, event| {
            if let Some(at) = nodes.iter().position(|its| *its == node) {
                board.show(at, event);
            }
        };
        let options = RunOptions::default().flash(given.flash).many(given.many.clone());
        let outcomes = machine::run(&mut *adapter, &package, &plan, &options, &show);
        board.finish();
        summary(context, path, &package, &plan, outcomes, given.report)
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
        let _ = io::stdin().lock().read_line(&mut line);
        match line.trim().to_ascii_lowercase().as_str() {
            "y" | "yes" => Ok(()),
            _ => Err(Failure::from(coflash_core::Error::Cancelled)),
        }
    }
}

/// Shows the outcome of each program of each device; the result of the command.
fn summary(
    context: &Context,
    path: &Path,
    package: &Package,
    plan: &Plan,
    outcomes: Vec<Outcome>,
    report: Option<&Path>,
) -> Result<(), Failure> {
    let out = context.out;
    let mut failures: Vec<Failure> = Vec::new();
    let mut devices: Vec<Value> = Vec::new();
    out.say("");
    let all = outcomes.len();
    for Outcome { node, entry, result, .. } in outcomes {
        let Some((its, _)) = package.programs().nth(entry) else { continue };
        let whom = node.map_or_else(|| "machine".to_owned(), |node| format!("node {node}"));
        let mut value = json!({
            "node": node.map(NodeId::get),
            "name": whom,
            "program": its.name,
            "image": its.file,
            "ok": result.is_ok(),
        });
        let device = plan.devices.iter().find(|device| Some(device.node) == node);
        if let Some(device) = device {
            let step = device.steps.iter().find(|step| step.entry == entry);
            value["serial_number"] = json!(device.identity[3]);
            value["from"] = json!(step.and_then(|step| step.from.as_ref()));
            value["to"] = json!(step.map(|step| &step.to));
        }
        match result {
            Ok(Good::Had) => {
                out.say(format_args!("{whom}: {}: it had this program", its.name));
                value["state"] = "had".into();
            }
            Ok(Good::Updated(report)) => {
                let took = report.took.as_secs_f64();
                out.say(format_args!("{whom}: {}: done in {took:.1} s", its.name));
                value["state"] = "updated".into();
                value["report"] = json!(report);
            }
            Err(bad) => {
                let failure = match bad {
                    Bad::Left(fault) => Failure::of_device(&fault),
                    Bad::Failed(failed) => Failure::from(failed.error).leaving(Some(failed.left)),
                };
                out.say(format_args!("{whom}: {}: {}", its.name, failure.to_string().trim_end()));
                value["state"] = "failed".into();
                value["error"] = failure.value()["error"].clone();
                failures.push(failure);
            }
        }
        devices.push(value);
    }
    let failed = failures.len();
    out.say(format_args!("{} of {all} programs are in their devices", all - failed));
    let document = json!({
        "command": "flash",
        "package": path.display().to_string(),
        "devices": devices,
        "foreign": plan.foreign,
        "failed": failed,
    });
    if let Some(report) = report {
        write_report(report, &document)?;
    }
    if all == 0 {
        return Err(Failure::no_device_for(path));
    }
    out.value(&document);
    let Some(first) = failures.first() else { return Ok(()) };
    let is_cancelled = failures.iter().any(|failure| failure.exit == Exit::Cancelled);
    let exit = if is_cancelled { Exit::Cancelled } else { Exit::Some };
    Err(Failure::told(exit, first.legacy, failed, all))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The options of `flash` that do beside a package what they do beside another file.
    const BESIDE_PACKAGES: [&str; 31] = [
        // What is done, and where it is said.
        "file",
        "legacy_file",
        "job",
        "report",
        "at_once",
        "together",
        "from_start",
        "block_repeats",
        "verify",
        "watch",
        "wait",
        "not_alone",
        "no_mastership",
        "dialect",
        "unlock",
        // Time limits and transfers.
        "boot_timeout",
        "command_timeout",
        "delay",
        "repeats",
        "sdo_attempts",
        "sdo_timeout",
        "segmented",
        "silence_timeout",
        // The bus; what is ignored or refused for any file is said for a package, too.
        "baudrate",
        "index",
        "vxd_type",
        "device_no",
        "ip_addr",
        "ip_port",
        "gateway_id",
        "network_id",
    ];

    /// A new option of `flash` needs a decision: it has an effect beside a package, or is refused there.
    #[test]
    fn each_option_of_flash_has_an_effect_beside_a_package_or_is_refused() {
        let command = super::super::commands();
        let flash = command.find_subcommand("flash").unwrap();
        let mut all: Vec<&str> = flash.get_arguments().map(|argument| argument.get_id().as_str()).collect();
        let decided = OF_PACKAGES.iter().chain(&FOR_PACKAGES).map(|(id, _)| *id);
        let mut decided: Vec<&str> = decided.chain(BESIDE_PACKAGES).collect();
        all.sort_unstable();
        decided.sort_unstable();
        assert_eq!(decided, all);
    }
}
