//! `coflash agent`: takes updates from a server.

use std::path::{Path, PathBuf};

use clap::Args;
use coflash_agent::{run, Buses, Config, Ended, Kind, Message, Options};
use coflash_core::device::legacy;
use coflash_core::file::limit::read_text;
use serde_json::json;

use super::context::Context;
use super::device::cancelled;
use super::output::{Exit, Failure};
use super::record;

/// Takes updates from an Eclipse hawkBit server.
///
/// It flashes them, and reports progress and result of each.
///
/// It asks the server for each device as often as the server wants, until Ctrl-C ends it. After a
/// restart it goes on where it was. The tokens come from files or from the environment.
#[derive(Debug, Args)]
pub(super) struct Agent {
    /// The URL of the server, in place of the one in the file.
    #[arg(long, value_name = "URL")]
    hawkbit: Option<String>,

    /// The file that names the devices, their buses and their tokens (see the manual).
    #[arg(long, value_name = "FILE", default_value = "agent.toml")]
    devices: PathBuf,

    /// Ask the server once for each device, do what it wants, and end.
    #[arg(long)]
    once: bool,
}

impl Agent {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        if context.trace.is_some() {
            let advice = "leave out --trace; --log-file has the frames of all buses";
            return Err(Failure::usage("an agent opens its buses again and again", advice));
        }
        let path = &self.devices;
        let text = read_text(path).map_err(|error| Failure::unreadable(path, &error))?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let config = Config::parse(&text, folder, self.hawkbit.as_deref(), context.bus.as_deref());
        let config = config.map_err(|fault| Failure::file(path, fault))?;
        let cancelled = cancelled()?;
        // Without random numbers the devices of several agents may ask at the same time.
        let seed = getrandom::u64().unwrap_or_default();
        let options = Options::default().once(self.once).seed(seed).cancelled(cancelled.clone());
        let report = |message: &Message| show(context, message);
        let count = config.targets.len();
        let noun = if count == 1 { "target" } else { "targets" };
        context.out.say(format_args!("{count} {noun}  (Ctrl-C ends it)"));
        let open = |bus: &str| {
            context.link_at(Some(bus), None).map_err(|failure| failure.to_string().trim_end().to_string())
        };
        let ended = run(&config, &options, &Buses::new(&open, cancelled.clone()), &report);
        let ended = ended.map_err(|error| Failure::system(error.to_string()))?;
        let Ended { updated, failed, unserved, .. } = ended;
        let words = format!("{updated} updated, {failed} failed, {unserved} not served");
        context.result(words, || json!({ "updated": updated, "failed": failed, "unserved": unserved }));
        match failed + unserved {
            // An agent that was ended is not to blame for what happened in its life.
            bad if bad > 0 && self.once => {
                let what = format!("{bad} of {count} devices failed");
                Err(Failure::several(Exit::Some, legacy::UNKNOWN, what))
            }
            _ => Ok(()),
        }
    }
}

/// Shows a message: a line for people, or an event.
fn show(context: &Context, said: &Message) {
    let Message { controller, kind, text, .. } = said;
    if let Some(update) = &said.update {
        record::failed(update, &[("controller", controller)]);
    }
    if context.out.shows_events() {
        record::note("said", &format!("{controller}: {text}"));
        context.out.event(&json!(said));
    } else if matches!(kind, Kind::Progress | Kind::Report) {
        context.out.detail(format_args!("{controller}: {text}"));
    } else {
        context.out.say(format_args!("{controller}: {text}"));
    }
}
