//! The devices and the server, from a TOML file.

use std::fmt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use canopen::NodeId;
use serde::Deserialize;
use shared_abi::layout::Layout;

use super::url::Server;
use coflash_core::file::board;
use coflash_core::file::sealed::PublicKey;

/// The server, and the devices that get updates from it.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Config {
    pub(super) server: Server,
    pub(super) tenant: String,
    /// The URL of the proxy before the server.
    pub(super) proxy: Option<String>,
    /// The certificates that the server's one must come from; `None` for the usual ones.
    pub(super) ca_file: Option<PathBuf>,
    /// The folder for what must survive a restart, and for downloads.
    pub(super) state: PathBuf,
    /// The shortest and longest pause between two polls of a device.
    pub(super) poll: (Duration, Duration),
    /// The targets, in the order of the file: first the devices, then the machines.
    pub targets: Vec<Target>,
}

/// What the server gives updates to.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Target {
    /// Its name on the server: the controllerId.
    pub controller: String,
    /// The URL of its bus.
    pub bus: String,
    /// What is there.
    pub what: TargetKind,
    pub(super) part: Option<String>,
    pub(super) artifact: Option<String>,
    pub(super) attempt: Attempt,
    pub(super) confirm: bool,
    pub(super) token: Token,
}

/// What a target is.
#[derive(Clone, Debug)]
pub enum TargetKind {
    /// One device, which gets programs.
    Device(Device),
    /// The devices of a bus, which get packages.
    Machine(Machine),
}

/// A machine: the devices of a bus that a package names.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Machine {
    /// The roots that may sign its packages; at least one.
    pub trust: Vec<PublicKey>,
    /// Whether programs are written that are older than those of the devices.
    pub allow_older: bool,
}

/// A device.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Device {
    /// Its node-ID.
    pub node: NodeId,
    /// The number of the program: sub-index of 1F50h.
    pub program: u8,
    /// Whether the update needs a device of the vendor-ID and product code that the file names.
    pub check_target: bool,
    /// Whether the program is tried before it is released for autostart.
    pub trial_run: bool,
    /// Whether the CRC of the running program is compared at the end.
    pub verify: bool,
    pub(super) board: Option<&'static Layout>,
}

/// What is done with a deployment that the server does not force.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Attempt {
    /// The device is updated at once.
    #[default]
    Update,
    /// The file is fetched, and waits until the server forces the deployment.
    Hold,
}

/// The value of the header `Authorization`.
#[derive(Clone, PartialEq, Eq)]
pub(super) struct Token(String);

impl Token {
    pub(super) fn header(&self) -> &str {
        &self.0
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("***")
    }
}

/// An error in the file, in words.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct Fault(String);

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct File {
    url: Option<String>,
    tenant: Option<String>,
    proxy: Option<String>,
    ca_file: Option<PathBuf>,
    state: Option<PathBuf>,
    #[serde(default)]
    plain_http: bool,
    poll_least: Option<u64>,
    poll_most: Option<u64>,
    gateway_token_file: Option<PathBuf>,
    gateway_token_env: Option<String>,
    bus: Option<String>,
    board: Option<String>,
    #[serde(default)]
    device: Vec<Entry<OneDevice>>,
    #[serde(default)]
    machine: Vec<Entry<OneMachine>>,
}

/// A target. The fields of its kind are in `T`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct Entry<T> {
    controller_id: String,
    bus: Option<String>,
    token_file: Option<PathBuf>,
    token_env: Option<String>,
    part: Option<String>,
    artifact: Option<String>,
    #[serde(default)]
    attempt: Attempt,
    #[serde(default)]
    confirm: bool,
    #[serde(flatten)]
    own: T,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "kebab-case")]
struct OneMachine {
    #[serde(default)]
    trust: Vec<PathBuf>,
    #[serde(default)]
    allow_older: bool,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "kebab-case")]
struct OneDevice {
    node: u8,
    board: Option<String>,
    program: Option<u8>,
    check_target: Option<bool>,
    trial_run: Option<bool>,
    #[serde(default)]
    verify: bool,
}

/// The longest controllerId and tenant that hawkBit knows.
const NAME_MOST: usize = 256;
/// The longest token.
const TOKEN_MOST: usize = 1024;
/// The longest poll interval that can be set: 30 days. Servers ask for more than a day.
const POLL_MOST: u64 = 30 * 24 * 3600;

/// The places of a token, as the file names them.
struct Source<'s> {
    file: Option<&'s Path>,
    env: Option<&'s str>,
    scheme: &'static str,
}

impl Config {
    /// Reads the text of a file. Paths in it are relative to `folder`; `url` replaces its URL, and
    /// `bus` is for devices without one. Tokens are read from their files and from the environment
    /// at once.
    ///
    /// # Errors
    /// The first error, in words.
    pub fn parse(text: &str, folder: &Path, url: Option<&str>, bus: Option<&str>) -> Result<Self, Fault> {
        Self::read(text, folder, (url, bus), &|name| std::env::var(name).ok()).map_err(Fault)
    }

    fn read(
        text: &str,
        folder: &Path,
        (url, bus): (Option<&str>, Option<&str>),
        variable: &dyn Fn(&str) -> Option<String>,
    ) -> Result<Self, String> {
        let mut file: File = toml::from_str(text).map_err(|error| {
            let at = error.span().map_or(0, |span| span.start.min(text.len()));
            let line = text.bytes().take(at).filter(|byte| *byte == b'\n').count() + 1;
            format!("line {line}: {}", error.message())
        })?;
        file.bus = file.bus.or_else(|| bus.map(String::from));
        let url = url.or(file.url.as_deref()).ok_or("it has no url: add it, or give --hawkbit URL")?;
        let server = Server::parse(url).map_err(|why| format!("url: {why}"))?;
        if server.is_open() && !file.plain_http {
            return Err(format!(
                "'{url}' would send the tokens over the network as plain text: use https://, or set plain-http = true"
            ));
        }
        if server.is_tls() && !cfg!(feature = "tls") {
            return Err(format!("'{url}' needs TLS, and this coflash was built without the feature tls"));
        }
        let tenant = file.tenant.unwrap_or_else(|| "DEFAULT".to_string());
        name("tenant", &tenant)?;
        if let Some(proxy) = &file.proxy {
            Server::parse(proxy).map_err(|why| format!("proxy: {why}"))?;
        }
        let (least, most) = (file.poll_least.unwrap_or(10), file.poll_most.unwrap_or(3600));
        if least == 0 || least > most || most > POLL_MOST {
            return Err(format!("poll-least and poll-most must be 1 to {POLL_MOST} seconds, in this order"));
        }
        let read = |source: Source<'_>| token(&source, folder, variable);
        let gateway = read(Source {
            file: file.gateway_token_file.as_deref(),
            env: file.gateway_token_env.as_deref(),
            scheme: "GatewayToken",
        })
        .map_err(|why| format!("the gateway token: {why}"))?;
        if file.device.is_empty() && file.machine.is_empty() {
            return Err("it names no device: add [[device]] with controller-id, bus and node".to_string());
        }
        let common = Common { bus: file.bus.as_deref(), gateway: gateway.as_ref(), token: &read };
        let mut targets: Vec<Target> = Vec::new();
        let mut add = |kind: &str, id: &str, target: Result<Target, String>| {
            let of = |why: String| format!("{kind} '{id}': {why}");
            let target = target.map_err(of)?;
            if let Some(other) = targets.iter().find(|other| other.is_the_same(&target)) {
                return Err(of(format!("it is the same {kind} as '{}', or has its name", other.controller)));
            }
            targets.push(target);
            Ok(())
        };
        for entry in &file.device {
            let what = || entry.own.device(file.board.as_deref(), folder).map(TargetKind::Device);
            add("device", &entry.controller_id, entry.target(&common, &what))?;
        }
        for entry in &file.machine {
            let what = || entry.own.machine(folder).map(TargetKind::Machine);
            add("machine", &entry.controller_id, entry.target(&common, &what))?;
        }
        Ok(Self {
            server,
            tenant,
            proxy: file.proxy,
            ca_file: file.ca_file.map(|path| folder.join(path)),
            state: folder.join(file.state.unwrap_or_else(|| "agent-state".into())),
            poll: (Duration::from_secs(least), Duration::from_secs(most)),
            targets,
        })
    }
}

/// What the file has for all targets.
struct Common<'f> {
    bus: Option<&'f str>,
    gateway: Option<&'f Token>,
    token: &'f dyn Fn(Source<'_>) -> Result<Option<Token>, String>,
}

impl Target {
    /// Whether both have one name, or are one device, or the machine of one bus.
    fn is_the_same(&self, other: &Self) -> bool {
        let is_one = match (&self.what, &other.what) {
            (TargetKind::Device(one), TargetKind::Device(other)) => one.node == other.node,
            (TargetKind::Machine(_), TargetKind::Machine(_)) => true,
            _ => false,
        };
        self.controller == other.controller || is_one && self.bus == other.bus
    }
}

impl<T> Entry<T> {
    fn target(
        &self,
        common: &Common<'_>,
        what: &dyn Fn() -> Result<TargetKind, String>,
    ) -> Result<Target, String> {
        name("controller-id", &self.controller_id)?;
        let own = (common.token)(Source {
            file: self.token_file.as_deref(),
            env: self.token_env.as_deref(),
            scheme: "TargetToken",
        })
        .map_err(|why| format!("its token: {why}"))?;
        let bus = self.bus.as_deref().or(common.bus).ok_or("it has no bus")?;
        coboot_can::check(bus).map_err(|error| error.to_string())?;
        let what = what()?;
        let advice = "it has no token: set token-file or token-env, or the gateway's one for all devices";
        Ok(Target {
            controller: self.controller_id.clone(),
            bus: bus.to_string(),
            what,
            part: self.part.clone(),
            artifact: self.artifact.clone(),
            attempt: self.attempt,
            confirm: self.confirm,
            token: own.or_else(|| common.gateway.cloned()).ok_or(advice)?,
        })
    }
}

impl OneMachine {
    fn machine(&self, folder: &Path) -> Result<Machine, String> {
        if self.trust.is_empty() {
            return Err("it trusts nobody: set trust to the public keys of the roots that sign its packages"
                .to_string());
        }
        let key = |path: &PathBuf| {
            let path = folder.join(path);
            let text = coflash_core::file::limit::read_text(&path);
            let of = |why: &dyn fmt::Display| format!("{}: {why}", path.display());
            PublicKey::from_pem(&text.map_err(|error| of(&error))?).map_err(|fault| of(&fault))
        };
        let trust = self.trust.iter().map(key).collect::<Result<_, _>>()?;
        Ok(Machine { trust, allow_older: self.allow_older })
    }
}

impl OneDevice {
    fn device(&self, board: Option<&str>, folder: &Path) -> Result<Device, String> {
        let node = NodeId::new(self.node).ok_or("node-IDs are 1 to 127")?;
        let board = self.board.as_deref().or(board).map(|word| board::in_folder(word, folder));
        let board = board.map(|word| board::named(&word)).transpose().map_err(|error| error.to_string())?;
        let program = self.program.unwrap_or(1);
        if !(1..=254).contains(&program) {
            return Err("programs are 1 to 254".to_string());
        }
        if let Some(board) = board.filter(|board| board.program(program).is_none()) {
            return Err(format!("{} has no program {program}", board.board));
        }
        Ok(Device {
            node,
            program,
            check_target: self.check_target.unwrap_or(true),
            trial_run: self.trial_run.unwrap_or(true),
            verify: self.verify,
            board,
        })
    }
}

/// Refuses a name that cannot be one on the server.
fn name(what: &str, name: &str) -> Result<(), String> {
    if name.is_empty() || name.len() > NAME_MOST || name.chars().any(char::is_control) {
        return Err(format!("{what} must have 1 to {NAME_MOST} characters"));
    }
    Ok(())
}

/// Reads a token; `None` if the file names no place for it.
fn token(
    source: &Source<'_>,
    folder: &Path,
    variable: &dyn Fn(&str) -> Option<String>,
) -> Result<Option<Token>, String> {
    let text = match (source.file, source.env) {
        (Some(_), Some(_)) => return Err("give a file or a variable, not both".to_string()),
        (None, None) => return Ok(None),
        (Some(path), None) => {
            let path = folder.join(path);
            coflash_core::file::limit::read_text(&path)
                .map_err(|error| format!("{}: {error}", path.display()))?
        }
        (None, Some(name)) => variable(name).ok_or_else(|| format!("the variable {name} is not set"))?,
    };
    let text = text.trim();
    // Nothing of the token goes into the message.
    if text.is_empty() || text.len() > TOKEN_MOST || !text.bytes().all(|byte| byte.is_ascii_graphic()) {
        return Err("it must be one word of letters, digits and signs".to_string());
    }
    Ok(Some(Token(format!("{} {text}", source.scheme))))
}

#[cfg(test)]
mod tests {
    use coflash_core::file::sealed::SigningKey;

    use super::*;

    const DOOR: &str =
        "[[device]]\ncontroller-id = 'door'\nbus = 'socketcan:can0'\nnode = 5\ntoken-env = 'DOOR'\n";

    fn root() -> PublicKey {
        SigningKey::from_seed([1; 32]).unwrap().public()
    }

    fn read(text: &str) -> Result<Config, String> {
        let variable = |name: &str| match name {
            "DOOR" => Some(" secret-of-the-door\n".to_string()),
            "ALL" => Some("secret-of-all".to_string()),
            "BROKEN" => Some("two words".to_string()),
            _ => None,
        };
        Config::read(text, Path::new("/etc/coflash"), (None, None), &variable)
    }

    #[test]
    fn a_device_has_its_own_token_or_the_gateways() {
        let text = format!(
            "url = 'http://localhost'\ngateway-token-env = 'ALL'\n{DOOR}[[device]]\ncontroller-id = 'lift'\n\
             bus = 'socketcan:can0'\nnode = 6\nattempt = 'hold'\nboard = 'stm32f407g-disc1'\n"
        );
        let config = read(&text).unwrap();
        let headers: Vec<&str> = config.targets.iter().map(|target| target.token.header()).collect();
        assert_eq!(headers, ["TargetToken secret-of-the-door", "GatewayToken secret-of-all"]);
        assert_eq!(config.targets[1].attempt, Attempt::Hold);
        assert_eq!(config.state, Path::new("/etc/coflash/agent-state"));
        assert!(!format!("{config:?}").contains("secret"), "{config:?}");
    }

    /// A machine trusts somebody, and a bus is that of one machine; devices may be on it, too.
    #[test]
    fn a_machine_names_the_roots_that_it_trusts() {
        let folder = std::env::temp_dir().join(format!("coflash-agent-machine-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(folder.join("root.pub"), root().to_pem()).unwrap();
        std::fs::write(folder.join("none.pub"), "none").unwrap();
        let machine = |id: &str, more: &str| {
            format!(
                "[[machine]]\ncontroller-id = '{id}'\nbus = 'socketcan:can0'\ntoken-env = 'ALL'\n{more}\n"
            )
        };
        let read = |more: &str| {
            let text = format!("url = 'http://localhost'\n{more}");
            Config::read(&text, &folder, (None, None), &|_| Some("t".to_string()))
        };
        let good = machine("press", "trust = ['root.pub']");
        let config = read(&format!("{DOOR}{good}")).unwrap();
        let [Target { what: TargetKind::Device(_), .. }, Target { what: TargetKind::Machine(machine_of), .. }] =
            config.targets.as_slice()
        else {
            panic!("{config:?}")
        };
        assert_eq!(machine_of.trust, [root()]);
        for (text, words) in [
            (machine("press", ""), "machine 'press': it trusts nobody"),
            (machine("press", "trust = []"), "it trusts nobody"),
            (machine("press", "trust = ['no.pub']"), "no.pub: "),
            (machine("press", "trust = ['none.pub']"), "none.pub: "),
            (machine("press", "trust = ['root.pub']\nnode = 5"), "unknown field `node`"),
            (good.clone() + &machine("other", "trust = ['root.pub']"), "the same machine as 'press'"),
            (DOOR.to_string() + &machine("door", "trust = ['root.pub']"), "has its name"),
            (format!("{DOOR}trust = ['root.pub']\n"), "unknown field `trust`"),
        ] {
            let why = read(&text).unwrap_err();
            assert!(why.contains(words), "{text}: {why}");
        }
        // The example of the page, with its files.
        std::fs::write(folder.join("gateway.token"), "t").unwrap();
        let page = include_str!("../../../docs/agent.md");
        let example = page.split("```toml\n").nth(1).and_then(|block| block.split("```").next()).unwrap();
        let config = Config::read(example, &folder, (None, None), &|_| Some("t".to_string())).unwrap();
        assert_eq!(config.targets.len(), 4);
        std::fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn a_fault_says_what_to_do() {
        let with = |line: &str| format!("url = 'http://localhost'\n{line}\n{DOOR}");
        for (text, words) in [
            (DOOR.to_string(), "--hawkbit URL"),
            ("url = 'http://localhost'\n".to_string(), "names no device"),
            (format!("url = 'http://hawkbit'\n{DOOR}"), "plain text"),
            (format!("url = 'ftp://hawkbit'\n{DOOR}"), "no URL of a server"),
            (with("speed = 5"), "line 2: "),
            (with("poll-least = 0"), "poll-least"),
            (with("poll-least = 60\npoll-most = 5"), "poll-least"),
            (with("tenant = ''"), "tenant"),
            (with(&DOOR.replace("node = 5", "node = 6")), "same device as 'door'"),
            (with(&DOOR.replace("'door'", "'gate'")), "same device"),
            (with("").replace("node = 5", "node = 128"), "node-IDs"),
            (with("").replace("bus = 'socketcan:can0'\n", ""), "device 'door': it has no bus"),
            (with("").replace("socketcan:can0", "nowhere"), "device 'door': "),
            (with("").replace("socketcan:can0", "cia309://h/net"), "its network must be a number"),
            (with("").replace("token-env = 'DOOR'", ""), "token-file or token-env"),
            (with("").replace("'DOOR'", "'NONE'"), "NONE is not set"),
            (with("").replace("'DOOR'", "'BROKEN'"), "one word"),
            (with("").replace("token-env = 'DOOR'", "token-file = 'none'"), "/etc/coflash/none"),
            (with("").replace("node = 5", "node = 5\nboard = 'x'"), "no board 'x'"),
            (
                with("").replace("node = 5", "node = 5\nboard = 'stm32f407g-disc1'\nprogram = 9"),
                "no program 9",
            ),
            (with("").replace("node = 5", "node = 5\nprogram = 0"), "programs are"),
        ] {
            let why = read(&text).unwrap_err();
            assert!(why.contains(words), "{text}: {why}");
            assert!(!why.contains("two words"), "{why}");
        }
    }
}
