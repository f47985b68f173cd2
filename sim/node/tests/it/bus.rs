//! Nodes and hosts as separate processes, and the folder of a test.

use std::cell::RefCell;
use std::ffi::OsString;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{channel, Receiver, RecvTimeoutError};
use std::time::Duration;
use std::{env, fs, thread};

use serde_json::Value;

/// How long a program may take before it counts as hanging.
const PATIENCE: Duration = Duration::from_secs(120);

/// The command that flashes the program of [`Folder::with_program`].
pub const FLASH: &[&str] = &["flash", "program.bin", "-I", "binary", "--board", "stm32f407g-disc1"];

/// The part of a program that a bootloader checks: initial stack pointer in RAM, reset vector
/// inside, Thumb bit set.
pub const VECTORS: [u8; 8] = [0x00, 0x00, 0x01, 0x20, 0x01, 0x02, 0x02, 0x08];

/// A program: its vectors, and then this byte.
pub fn program(byte: u8, len: usize) -> Vec<u8> {
    let mut bytes = vec![byte; len];
    bytes[..8].copy_from_slice(&VECTORS);
    bytes
}

/// A folder for one test, deleted at the end.
pub struct Folder(kit::folder::Folder);

impl Folder {
    pub fn new(test: &str) -> Self {
        Self(kit::folder::Folder::below(env!("CARGO_TARGET_TMPDIR"), test))
    }

    /// A folder that contains `program.bin`.
    pub fn with_program(test: &str, program: &[u8]) -> Self {
        let folder = Self::new(test);
        folder.write("program.bin", program);
        folder
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    pub fn write(&self, name: &str, bytes: &[u8]) {
        fs::write(self.path(name), bytes).unwrap();
    }

    pub fn read(&self, name: &str) -> Vec<u8> {
        fs::read(self.path(name)).unwrap()
    }

    /// A part of a flash. The node replaces its file as a whole.
    pub fn part(&self, name: &str, offset: usize, len: usize) -> Vec<u8> {
        let mut bytes = vec![0; len];
        let mut file = fs::File::open(self.path(name)).unwrap();
        file.seek(SeekFrom::Start(offset as u64)).unwrap();
        file.read_exact(&mut bytes).unwrap();
        bytes
    }

    /// Waits until a flash has other bytes than FFh at this offset.
    pub fn await_bytes(&self, name: &str, offset: usize) {
        while self.part(name, offset, 64) == [0xFF; 64] {
            thread::sleep(Duration::from_millis(5));
        }
    }
}

/// The output of a program that has ended.
pub struct Done {
    pub exit: i32,
    pub out: String,
    pub err: String,
}

/// A running program; killed when this value is dropped.
pub struct Running {
    child: Child,
    err: thread::JoinHandle<String>,
    out: Receiver<String>,
    said: RefCell<String>,
}

impl Running {
    fn start(command: &mut Command) -> Self {
        let command = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap_or_else(|error| panic!("{command:?}: {error}"));
        let (stdout, mut stderr) = (child.stdout.take().unwrap(), child.stderr.take().unwrap());
        let (lines, out) = channel();
        thread::spawn(move || {
            for line in BufReader::new(stdout).lines().map_while(Result::ok) {
                let _ = lines.send(line);
            }
        });
        let err = thread::spawn(move || {
            let mut text = String::new();
            let _ = stderr.read_to_string(&mut text);
            text
        });
        Self { child, err, out, said: RefCell::default() }
    }

    /// The process id.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// The next line; `None` after the last one.
    fn line(&self) -> Option<String> {
        match self.out.recv_timeout(PATIENCE) {
            Ok(line) => {
                *self.said.borrow_mut() += &format!("{line}\n");
                Some(line)
            }
            Err(RecvTimeoutError::Disconnected) => None,
            Err(RecvTimeoutError::Timeout) => panic!("it hangs; it said: {}", self.said.borrow()),
        }
    }

    /// Waits for a line that contains this text.
    #[track_caller]
    pub fn await_text(&self, text: &str) -> String {
        while let Some(line) = self.line() {
            if line.contains(text) {
                return line;
            }
        }
        panic!("it never says {text:?}, but: {}", self.said.borrow());
    }

    /// Waits until the program has ended by itself.
    pub fn wait(mut self) -> Done {
        // Closes standard input.
        drop(self.child.stdin.take());
        while self.line().is_some() {}
        let exit = self.child.wait().unwrap().code().unwrap_or(-1);
        let err = std::mem::replace(&mut self.err, thread::spawn(String::new)).join().unwrap();
        Done { exit, out: self.said.take(), err }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// `coboot-node` in the folder of a test.
pub fn node(folder: &Folder, arguments: &[&str]) -> Running {
    Running::start(Command::new(env!("CARGO_BIN_EXE_coboot-node")).args(arguments).current_dir(&folder.0))
}

/// Running nodes.
pub struct Nodes {
    running: Running,
    url: String,
}

impl Nodes {
    /// Nodes with their own bus.
    pub fn start(folder: &Folder, arguments: &[&str]) -> Self {
        let running = node(folder, &[&["--listen", "127.0.0.1:0"], arguments].concat());
        let line = running.line().unwrap_or_default();
        let Some(url) = line.strip_prefix("bus: ").map(str::to_owned) else {
            panic!("{line:?}: {}", running.wait().err)
        };
        Self { running, url }
    }

    /// Nodes on an existing bus.
    pub fn join(folder: &Folder, url: &str, arguments: &[&str]) -> Self {
        let running = node(folder, &[&["--bus", url], arguments].concat());
        Self { running, url: url.to_owned() }
    }

    pub fn url(&self) -> &str {
        &self.url
    }

    pub fn address(&self) -> &str {
        self.url.trim_start_matches("socketcand://").trim_end_matches("/can0")
    }

    /// Waits for this line of the nodes.
    #[track_caller]
    pub fn await_line(&self, line: &str) {
        self.running.await_text(line);
    }

    /// Waits until the nodes have ended by themselves.
    pub fn ended(self) -> Done {
        self.running.wait()
    }
}

/// The host tool in the folder of a test, with a bus.
pub struct Coflash {
    folder: PathBuf,
    url: String,
}

/// Nodes in a folder, and the host tool on their bus.
pub fn start(folder: Folder, arguments: &[&str]) -> (Folder, Nodes, Coflash) {
    let nodes = Nodes::start(&folder, arguments);
    let coflash = Coflash::new(&folder, &nodes);
    (folder, nodes, coflash)
}

impl Coflash {
    pub fn new(folder: &Folder, nodes: &Nodes) -> Self {
        Self { folder: folder.path(""), url: nodes.url().to_owned() }
    }

    pub fn spawn(&self, arguments: &[&str]) -> Running {
        self.spawn_at(arguments, &self.folder)
    }

    /// The same with its locks in another folder, as on another computer.
    pub fn spawn_at(&self, arguments: &[&str], locks: &Path) -> Running {
        let nowhere = self.folder.join("nowhere");
        Running::start(
            Command::new(host_tool())
                .args(arguments)
                .current_dir(&self.folder)
                .env("COFLASH_BUS", &self.url)
                .env("XDG_CONFIG_HOME", &nowhere)
                .env("XDG_STATE_HOME", &nowhere)
                .env("XDG_RUNTIME_DIR", locks)
                .env_remove("COFLASH_CONFIG"),
        )
    }

    pub fn run(&self, arguments: &[&str]) -> Done {
        self.spawn(arguments).wait()
    }

    /// Runs the tool with this text on standard input.
    pub fn typed(&self, arguments: &[&str], text: &str) -> Done {
        let mut running = self.spawn(arguments);
        running.child.stdin.take().unwrap().write_all(text.as_bytes()).unwrap();
        running.wait()
    }

    /// The output of a successful call.
    #[track_caller]
    pub fn done(&self, arguments: &[&str]) -> String {
        let done = self.run(arguments);
        assert_eq!(done.exit, 0, "{arguments:?}: {}{}", done.out, done.err);
        done.out
    }

    /// The output of a successful call as JSON.
    #[track_caller]
    pub fn json(&self, arguments: &[&str]) -> Value {
        let out = self.done(&[arguments, &["--json"]].concat());
        serde_json::from_str(&out).unwrap_or_else(|error| panic!("{error}: {out}"))
    }
}

/// coflash's example of a production line, with its locks in the folder of a test.
pub fn station(folder: &Folder, arguments: &[&str]) -> Done {
    let example = beside("examples/production_line");
    Running::start(Command::new(example).args(arguments).env("XDG_RUNTIME_DIR", folder.path(""))).wait()
}

/// `COBOOT_COFLASH`, or the program built beside the nodes.
fn host_tool() -> OsString {
    env::var_os("COBOOT_COFLASH").unwrap_or_else(|| beside("coflash").into_os_string())
}

/// A program of coflash that is built beside the nodes.
fn beside(name: &str) -> PathBuf {
    let name = Path::new(name).with_extension(env::consts::EXE_EXTENSION);
    let path = Path::new(env!("CARGO_BIN_EXE_coboot-node")).with_file_name(name);
    assert!(
        path.exists(),
        "{}: build it by `cargo build -p coflash -p coflash-core --bins --examples`, or run `cargo xtask test`",
        path.display()
    );
    path
}

/// The next message of a server.
pub fn message(stream: &mut TcpStream) -> String {
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let mut text = String::new();
    let mut byte = [0];
    while !text.ends_with('>') {
        stream.read_exact(&mut byte).unwrap();
        text.push(byte[0].into());
    }
    text
}
