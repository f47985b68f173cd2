//! The tool as a separate process.

pub mod kernel;

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use coboot_can::Adapter;
use kit::fake::{serve, Blocks, Fake, BOOTLOADER};
use kit::folder::Folder;
use serde_json::Value;

/// A device without long delays.
pub fn quick(running: u32) -> Fake {
    let mut fake = Fake::new(running);
    fake.erase_time = Duration::from_millis(30);
    fake.restart_time = Duration::from_millis(20);
    fake
}

/// Such a device with something changed.
pub fn device(running: u32, change: impl FnOnce(&mut Fake)) -> Fake {
    let mut fake = quick(running);
    change(&mut fake);
    fake
}

/// A bootloader that takes block transfers.
pub fn bootloader() -> Fake {
    device(BOOTLOADER, |fake| fake.knows_blocks = Blocks::Known(127))
}

pub struct Done {
    /// The command with its words and variables.
    call: String,
    pub exit: i32,
    pub out: String,
    pub err: String,
}

impl Done {
    /// Checks that the command has succeeded.
    #[track_caller]
    pub fn good(self) -> Self {
        self.ends(0, "", &[]);
        self
    }

    /// Checks that the command has succeeded, with all these words on standard output.
    #[track_caller]
    pub fn says(self, words: &[&str]) -> Self {
        self.ends(0, &self.out, words);
        self
    }

    /// Checks that the command has failed with this exit code and all these words.
    #[track_caller]
    pub fn fails(&self, exit: i32, words: &[&str]) {
        self.ends(exit, &self.err, words);
    }

    #[track_caller]
    fn ends(&self, exit: i32, text: &str, words: &[&str]) {
        let Self { call, exit: found, out, err } = self;
        let missing: Vec<&&str> = words.iter().filter(|words| !text.contains(**words)).collect();
        assert!(
            *found == exit && missing.is_empty(),
            "{call}: {found} and not {exit}, {missing:?}: {out}{err}"
        );
    }

    /// The document on standard output.
    #[track_caller]
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.out).unwrap_or_else(|error| panic!("{error}: {}{}", self.out, self.err))
    }
}

/// The tool without the settings, the adapters and the locks of the user who runs the tests.
pub fn command() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_coflash"));
    // No test makes this folder. Without a folder for locks there are none: two tests may use the
    // same name of an adapter at the same time.
    let nowhere = Path::new(env!("CARGO_TARGET_TMPDIR")).join("nowhere");
    for name in ["XDG_CONFIG_HOME", "XDG_STATE_HOME", "XDG_RUNTIME_DIR"] {
        // A state folder is made at once.
        command.env(name, nowhere.join(name));
    }
    command.env_remove("COFLASH_BUS").env_remove("COFLASH_CONFIG");
    command.env("COFLASH_SEARCH", "none").env("NO_COLOR", "1");
    command
}

/// The tool, started by another program with these arguments.
#[cfg(unix)]
pub fn within(program: &str, arguments: &[&str]) -> Command {
    let tool = command();
    let mut outer = Command::new(program);
    outer.args(arguments).arg(tool.get_program());
    outer.envs(tool.get_envs().filter_map(|(name, value)| Some((name, value?))));
    outer
}

/// A bus with a valid URL that does not exist.
pub const NOWHERE: &str = "socketcand://127.0.0.1:1/x";

pub fn coflash(arguments: &[&str]) -> Done {
    run(command().args(arguments))
}

/// Runs the tool with these words on the bus of a device; gives the device, too.
pub fn served<A: Adapter + Send + 'static>(fake: A, words: &[&str]) -> (Done, A) {
    let (bus, server) = serve(fake);
    let done = coflash(&[&["--bus", &bus], words].concat());
    (done, server.join().unwrap())
}

pub fn run(command: &mut Command) -> Done {
    let done = command.output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    let exit = done.status.code().expect("no signal");
    Done { call: format!("{command:?}"), exit, out: text(done.stdout), err: text(done.stderr) }
}

pub fn data(name: &str) -> String {
    format!("{}/../core/tests/data/{name}", env!("CARGO_MANIFEST_DIR"))
}

/// Compares with `tests/snapshots/NAME.txt`, which a person has read and approved. With
/// `COFLASH_BLESS` in the environment the file is written instead.
#[track_caller]
pub fn snapshot(name: &str, found: &str) {
    let path = format!("{}/tests/snapshots/{name}.txt", env!("CARGO_MANIFEST_DIR"));
    if std::env::var_os("COFLASH_BLESS").is_some() {
        fs::write(&path, found).unwrap();
    }
    let expected = fs::read_to_string(&path).unwrap_or_default();
    assert!(found == expected, "{path} says\n{expected}\nand now it is\n{found}");
}

/// A folder of one test, deleted at its end.
pub fn folder(test: &str) -> Folder {
    Folder::below(env!("CARGO_TARGET_TMPDIR"), test)
}
