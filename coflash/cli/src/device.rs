//! The options that name a device and set its time limits, for every command that talks to one.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use canopen::NodeId;
use clap::Args;
use coboot_can::Link;
use coflash_core::device::{Session, Timing, Transfers};
use coflash_core::Error;

use super::output::{Exit, Failure};
use super::record;
use super::values::{attempts, milliseconds, node_id, number, program_number};

/// One device.
#[derive(Debug, Args)]
pub(super) struct Device {
    /// The device's node-ID.
    #[arg(long, short = 'N', alias = "node_id", default_value = "1", value_parser = node_id, value_name = "1..127")]
    node: NodeId,

    #[command(flatten)]
    patience: Patience,
}

/// One program of one device.
#[derive(Debug, Args)]
pub(super) struct Program {
    #[command(flatten)]
    pub(super) device: Device,

    /// The program number: sub-index of 1F51h, 1F56h and 1F57h.
    #[arg(long, short = 'P', alias = "prog_no", value_name = "1..254", value_parser = program_number, default_value = "1")]
    pub(super) program: u8,
}

impl Device {
    /// A session that [a signal](cancelled) ends.
    pub(super) fn session<'a>(&self, link: &'a mut Link) -> Result<Session<'a>, Failure> {
        self.patience.session(link, self.node)
    }
}

/// The time limits.
#[derive(Debug, Args)]
pub(super) struct Patience {
    /// How long the answer to one request may take, in milliseconds.
    #[arg(long, aliases = ["sdo_timeout", "timeout"], default_value = "500", value_parser = milliseconds, value_name = "MS")]
    sdo_timeout: Duration,

    /// How many times a request that may be repeated is sent if no answer comes.
    #[arg(long, default_value = "3", value_parser = attempts, value_name = "TIMES", hide_short_help = true)]
    sdo_attempts: u32,

    /// How long a command (such as erase) may take, in milliseconds.
    #[arg(long, default_value = "60000", value_parser = milliseconds, value_name = "MS", hide_short_help = true)]
    command_timeout: Duration,

    /// How long a device may send nothing while it executes a command, in milliseconds.
    #[arg(long, default_value = "10000", value_parser = milliseconds, value_name = "MS", hide_short_help = true)]
    silence_timeout: Duration,

    /// How long a restart may take, in milliseconds.
    #[arg(long, default_value = "5000", value_parser = milliseconds, value_name = "MS", hide_short_help = true)]
    boot_timeout: Duration,

    /// The pause between two status requests to a busy device, in milliseconds; by default 10 at
    /// first and at most 250.
    #[arg(long, value_parser = milliseconds, value_name = "MS", conflicts_with = "command_timeout", hide_short_help = true)]
    delay: Option<Duration>,

    /// How many status requests a busy device gets before it is given up, with a pause of --delay
    /// (or a second) between them; replaces --command-timeout.
    #[arg(long, value_parser = number, value_name = "TIMES", conflicts_with = "command_timeout", hide_short_help = true)]
    repeats: Option<u32>,

    /// Download in segments, even if the device supports block transfer.
    #[arg(long, hide_short_help = true)]
    segmented: bool,
}

/// The manual's defaults (table 9) for `--delay` and `--repeats` if only one of them is given.
const DELAY: Duration = Duration::from_secs(1);
const REPEATS: u32 = 0x400;

impl Patience {
    /// A session that [a signal](cancelled) ends.
    pub(super) fn session<'a>(&self, link: &'a mut Link, node: NodeId) -> Result<Session<'a>, Failure> {
        let mut session = Session::on(link, node, self.timing());
        session.cancel_by(cancelled()?);
        session.transfer_by(self.transfers());
        Ok(session)
    }

    pub(super) fn transfers(&self) -> Transfers {
        if self.segmented {
            Transfers::Segments
        } else {
            Transfers::Blocks
        }
    }

    pub(super) fn timing(&self) -> Timing {
        let timing = Timing::default()
            .sdo(self.sdo_timeout)
            .attempts(self.sdo_attempts)
            .command(self.command_timeout)
            .silent(self.silence_timeout)
            .boot(self.boot_timeout);
        if self.delay.is_none() && self.repeats.is_none() {
            return timing;
        }
        let delay = self.delay.unwrap_or(DELAY);
        let command = delay.saturating_mul(self.repeats.unwrap_or(REPEATS).max(1));
        timing.command(command).poll_first(delay).poll_most(delay)
    }
}

/// Whether the user is asked something: nothing is under way that could be ended in order.
static ASKED: AtomicBool = AtomicBool::new(false);

/// Signals within this time are one: a terminal that is closed sends SIGHUP twice, by the system
/// and by its shell.
const ONE_SIGNAL: Duration = Duration::from_secs(1);

/// The flag that Ctrl-C sets, and likewise SIGTERM (the stop of a service) and SIGHUP (a terminal
/// that is closed); on Windows Ctrl-Break, while a console that is closed waits for nobody. The
/// first signal ends a transfer in an orderly way, a later one ends the program at once.
pub(super) fn cancelled() -> Result<Arc<AtomicBool>, Failure> {
    static FLAG: OnceLock<Arc<AtomicBool>> = OnceLock::new();
    if let Some(flag) = FLAG.get() {
        return Ok(flag.clone());
    }
    #[cfg(target_os = "linux")]
    keep_ignored();
    let flag = FLAG.get_or_init(Arc::default).clone();
    let cancelled = flag.clone();
    let mut first: Option<Instant> = None;
    ctrlc::set_handler(move || {
        let was_set = cancelled.swap(true, Ordering::Relaxed);
        let is_later = first.is_some_and(|first| first.elapsed() >= ONE_SIGNAL);
        if ASKED.load(Ordering::Relaxed) || was_set && is_later {
            let _ = record::end(Exit::Cancelled as u32, Some(Failure::from(Error::Cancelled).recorded()));
            std::process::exit(Exit::Cancelled as i32);
        }
        if !was_set {
            first = Some(Instant::now());
        }
    })
    .map_err(|error| Failure::system(format!("Ctrl-C cannot be caught: {error}")))?;
    Ok(flag)
}

/// What `nohup` has started outlives its terminal (POSIX): a SIGHUP that was ignored at the start
/// is blocked in this thread, and in those that it starts.
#[cfg(target_os = "linux")]
fn keep_ignored() {
    use nix::sys::signal::{SigSet, Signal};
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    // A bit for each signal from number 1 on, proc(5): SIGHUP has the lowest.
    let ignored = ignored.and_then(|signals| u64::from_str_radix(signals.trim(), 16).ok());
    if ignored.is_some_and(|signals| signals & 1 != 0) {
        let _ = SigSet::from(Signal::SIGHUP).thread_block();
    }
}

/// Waits for what the user says. A signal meanwhile ends the program at once.
pub(super) fn asked<T>(wait: impl FnOnce() -> T) -> Result<T, Failure> {
    cancelled()?;
    ASKED.store(true, Ordering::Relaxed);
    let said = wait();
    ASKED.store(false, Ordering::Relaxed);
    Ok(said)
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        patience: Patience,
    }

    fn timing(words: &[&str]) -> Timing {
        Line::try_parse_from([&["coflash"], words].concat())
            .unwrap_or_else(|error| panic!("{error}"))
            .patience
            .timing()
    }

    #[test]
    fn delay_and_repeats_are_those_of_the_manuals_tool() {
        let ms = Duration::from_millis;
        assert_eq!(timing(&[]), Timing::default());
        // Table 9: 400h status requests, a second apart, and an SDO time-out of 500 ms.
        let legacy = timing(&["--delay", "1000", "--repeats", "0x000400", "--timeout", "500"]);
        assert_eq!(
            (legacy.command, legacy.poll_first, legacy.poll_most),
            (ms(1_024_000), ms(1000), ms(1000))
        );
        assert_eq!(legacy.sdo, ms(500));
        assert_eq!(timing(&["--delay", "20"]).command, ms(20 * 1024));
        assert_eq!(timing(&["--repeats", "3"]).command, ms(3000));
        assert_eq!(timing(&["--sdo-attempts", "7"]).attempts, 7);
        assert!(Line::try_parse_from(["coflash", "--sdo-attempts", "0"]).is_err());
        let own = timing(&["--sdo-timeout", "7", "--command-timeout", "8", "--boot-timeout", "9"]);
        assert_eq!((own.sdo, own.command, own.boot), (ms(7), ms(8), ms(9)));
        assert_eq!(own.poll_first, Timing::default().poll_first);
        assert!(Line::try_parse_from(["coflash", "--delay", "1", "--command-timeout", "1"]).is_err());
    }
}
