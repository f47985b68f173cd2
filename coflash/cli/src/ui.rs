//! `coflash ui`: the page in the browser.

use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use clap::Args;
use coflash_core::machine::{self, Package};
use coflash_ui::{Failed, Options, Origin, Server, Service};
use serde_json::json;
use tempfile::NamedTempFile;

use super::context::Context;
use super::device::cancelled;
use super::flash;
use super::memory;
use super::output::Failure;
use super::package::{self, Trusted, Typed};
use super::record;

/// Serves a page for the browser, to this computer only.
///
/// The page has scan, update, LSS and the bus in words.
///
/// With --service the page is for people who update machines: it takes this one package or job file, has nothing
/// else to choose, and saves a report about each device in the folder of --report-dir; without it, in
/// coflash-reports in the home folder.
///
/// The command prints the URL of the page, which contains a random token: anyone with the URL can
/// do everything that the page offers. Ctrl-C ends the command; a running update is ended in an
/// orderly way.
#[derive(Debug, Args)]
pub(super) struct Ui {
    // The first one: the parser takes each value out as it reads it.
    #[command(flatten)]
    typed: Typed,

    /// The port on 127.0.0.1; by default a free one.
    #[arg(long, value_name = "PORT", default_value = "0", hide_default_value = true)]
    port: u16,

    /// Print the URL without opening a browser.
    #[arg(long)]
    no_open: bool,

    /// Be a service station for the machines of this package, or of this job file (.toml).
    #[arg(long, value_name = "FILE")]
    service: Option<PathBuf>,

    #[command(flatten)]
    trusted: Trusted,
}

impl Ui {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        if context.trace.is_some() {
            let advice = "leave out --trace, and save the log from the page";
            return Err(Failure::usage("the page keeps the log of the frames itself", advice));
        }
        let end = cancelled()?;
        let mut options = Options::default();
        options.bus = context.bus.clone();
        options.port = self.port;
        options.kinds = context.kinds();
        options.failed = Failed::new(|update| record::failed(update, &[]));
        options.sdo_ids = context.sdo_ids();
        options.version = env!("COFLASH_VERSION").to_owned();
        self.typed.check(self.service.is_some(), &flash::options())?;
        if let Some(path) = &self.service {
            options.service = Some(self.station(context, path)?);
        }
        let server = Server::new(options).map_err(|error| {
            Failure::system(format!("port {} of 127.0.0.1 cannot be served: {error}", self.port))
        })?;
        let url = server.url();
        context.result(format_args!("{url}  (Ctrl-C ends it)"), || json!({ "url": url }));
        let door = (!self.no_open).then(|| in_browser(&url));
        if let Some(Err(error)) = &door {
            context.out.warn(format_args!("the page is in no browser ({error}): open the URL yourself"));
        }
        let left = server
            .run(&end)
            .map_err(|error| Failure::system(format!("the page cannot be served: {error}")))?;
        match left {
            Some(words) => context.out.warn(words),
            None => context.out.say("the page has ended"),
        }
        Ok(())
    }

    /// The service station for a package or a job file, which is checked as by `flash`.
    fn station(&self, context: &Context, path: &Path) -> Result<Service, Failure> {
        let (package, origin) = if path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("toml"))
        {
            (of_job(path, &self.trusted)?, Origin::Job)
        } else {
            let checked = package::read(path, &self.trusted)?;
            checked.signers().iter().for_each(|line| context.out.say(line));
            let origin = checked.known.map_or(Origin::Package, Origin::Trusted);
            (checked.package, origin)
        };
        let folder = context
            .report_dir
            .clone()
            .unwrap_or_else(|| std::env::home_dir().unwrap_or_default().join("coflash-reports"));
        let service = Service::new(package, path, origin, &folder).map_err(|error| {
            let what = format!("reports cannot be saved in {}: {error}", folder.display());
            Failure::usage(what, "name another folder with --report-dir")
        })?;
        context.out.say(format_args!("reports are saved in {}", service.report_dir().display()));
        let memory = memory::file("service-bus");
        let forgets =
            |why: &String| context.out.warn(format_args!("the adapter is chosen anew at each start: {why}"));
        Ok(service.memory(memory.inspect_err(forgets).ok()))
    }
}

/// Opens the page in the browser, by a file that leads to it: every user of the computer can read the arguments of
/// the browser, and the file is for its owner alone. It is removed when it is dropped.
fn in_browser(url: &str) -> io::Result<NamedTempFile> {
    let mut name = tempfile::Builder::new();
    name.prefix("coflash-").suffix(".html");
    // A browser in a sandbox (snap) has a folder for temporary files of its own, and reads the home folder.
    let home = std::env::home_dir().and_then(|home| name.tempfile_in(home).ok());
    let mut file = home.map_or_else(|| name.tempfile(), Ok)?;
    writeln!(
        file,
        "<!doctype html>\n<meta charset=\"utf-8\">\n<title>coflash</title>\n\
         <meta http-equiv=\"refresh\" content=\"0; url={url}\">\n<a href=\"{url}\">coflash</a>"
    )?;
    open::that_detached(file.path())?;
    Ok(file)
}

/// Makes the package that does what a job file says, for a service station.
fn of_job(path: &Path, trusted: &Trusted) -> Result<Package, Failure> {
    if !trusted.trust.is_empty() {
        let advice = "leave --trust out, or make a signed package (coflash package)";
        return Err(Failure::usage("a job file has no signature", advice));
    }
    let recipe = package::read_recipe(path)?;
    let parts = recipe.parts().map_err(|fault| Failure::recipe(path, &fault))?;
    let made = machine::make(recipe.name, recipe.release, &parts, &[]);
    made.and_then(|bytes| Package::parse(&bytes)).map_err(|fault| Failure::package(path, &fault))
}
