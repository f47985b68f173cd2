//! The messages of hawkBit's Direct Device Integration API, as JSON.
//!
//! Everything here comes from a network: what is missing, too long or of another kind is a fault in
//! words. What this agent does not use is ignored.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::pause;

/// The most deployments' chunks and artifacts that are read.
const PARTS_MOST: usize = 64;
/// The longest id of an action, and the longest name of a file.
const ID_MOST: usize = 64;
const NAME_MOST: usize = 255;
/// The longest part of a wrong value that is shown, in characters.
const SHOWN_MOST: usize = 40;
/// The most lines of feedback: hawkBit keeps 50.
pub(super) const LINES_MOST: usize = 50;
/// The longest line of feedback, in characters: hawkBit keeps 512.
const LINE_MOST: usize = 500;
/// The longest key and value of an attribute: hawkBit keeps 32 and 128.
const KEY_MOST: usize = 32;
const VALUE_MOST: usize = 128;

/// The answer of a device's root resource.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Base {
    /// The pause that the server asks for; the error is its text, if it is none.
    pub(super) sleep: Option<Result<Duration, String>>,
    pub(super) deployment: Option<String>,
    pub(super) cancel: Option<String>,
    pub(super) config: bool,
    pub(super) confirmation: Option<String>,
}

#[derive(Deserialize)]
struct Link {
    href: String,
}

type Links = BTreeMap<String, serde_json::Value>;

/// The link of this name, if it is one.
fn link(links: &Links, name: &str) -> Option<String> {
    Link::deserialize(links.get(name)?).ok().map(|link| link.href)
}

impl Base {
    pub(super) fn parse(body: &[u8]) -> Result<Self, String> {
        #[derive(Deserialize)]
        struct Body {
            config: Option<serde_json::Value>,
            #[serde(default, rename = "_links")]
            links: Links,
        }
        let Body { config, links } = read(body)?;
        let sleep = config.as_ref().and_then(|config| config.pointer("/polling/sleep"));
        let sleep = sleep.filter(|sleep| !sleep.is_null());
        let parsed = |sleep: &serde_json::Value| sleep.as_str().and_then(pause::parse);
        Ok(Self {
            sleep: sleep.map(|sleep| parsed(sleep).ok_or_else(|| visible(&sleep.to_string(), SHOWN_MOST))),
            deployment: link(&links, "deploymentBase"),
            cancel: link(&links, "cancelAction"),
            config: link(&links, "configData").is_some(),
            confirmation: link(&links, "confirmationBase"),
        })
    }
}

/// A text of the server as safe text of limited length.
fn visible(text: &str, most: usize) -> String {
    let visible = |c: char| if c.is_alphanumeric() || c.is_ascii_graphic() || c == ' ' { c } else { '_' };
    text.chars().take(most).map(visible).collect()
}

/// How urgent a part of a deployment is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Handling {
    /// Not yet.
    Skip,
    /// The agent may wait.
    Attempt,
    /// At once.
    #[default]
    Forced,
}

/// A deployment.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Deployment {
    pub(super) action: String,
    pub(super) download: Handling,
    pub(super) update: Handling,
    /// Whether the maintenance window is closed: the file may be fetched, and no more.
    pub(super) closed: bool,
    pub(super) chunks: Vec<Chunk>,
}

/// A software module of a deployment.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
pub(super) struct Chunk {
    #[serde(default)]
    pub(super) part: String,
    #[serde(default)]
    pub(super) artifacts: Vec<Artifact>,
}

/// A file of a deployment.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
pub(super) struct Artifact {
    pub(super) filename: String,
    pub(super) size: u64,
    #[serde(default)]
    hashes: BTreeMap<String, String>,
    #[serde(default, rename = "_links", deserialize_with = "hrefs")]
    links: BTreeMap<String, String>,
}

fn hrefs<'d, D: serde::Deserializer<'d>>(from: D) -> Result<BTreeMap<String, String>, D::Error> {
    let links = Links::deserialize(from)?;
    Ok(links.keys().filter_map(|name| Some((name.clone(), link(&links, name)?))).collect())
}

impl Artifact {
    /// The SHA-256 in small letters, if the server gives one.
    pub(super) fn sha256(&self) -> Option<String> {
        let hash = self.hashes.get("sha256")?.to_ascii_lowercase();
        (hash.len() == 64 && hash.bytes().all(|byte| byte.is_ascii_hexdigit())).then_some(hash)
    }

    /// The link to download it: over TLS, if there is one.
    pub(super) fn link(&self) -> Option<&str> {
        self.links.get("download").or_else(|| self.links.get("download-http")).map(String::as_str)
    }

    /// The file's name as safe text.
    pub(super) fn name(&self) -> String {
        visible(&self.filename, NAME_MOST)
    }
}

impl Deployment {
    pub(super) fn parse(body: &[u8]) -> Result<Self, String> {
        #[derive(Deserialize)]
        struct Inner {
            #[serde(default)]
            download: Handling,
            #[serde(default)]
            update: Handling,
            #[serde(rename = "maintenanceWindow")]
            window: Option<String>,
            #[serde(default)]
            chunks: Vec<Chunk>,
        }
        #[derive(Deserialize)]
        struct Body {
            id: Id,
            deployment: Inner,
        }
        let Body { id, deployment } = read(body)?;
        let Inner { download, update, window, chunks } = deployment;
        if chunks.iter().map(|chunk| 1 + chunk.artifacts.len()).sum::<usize>() > PARTS_MOST {
            return Err(format!("a deployment of more than {PARTS_MOST} parts"));
        }
        let closed = window.is_some_and(|window| window != "available");
        Ok(Self { action: id.checked()?, download, update, closed, chunks })
    }
}

/// Whether a text can be the id of an action, which becomes a part of URLs.
pub(super) fn is_id(text: &str) -> bool {
    let fits = |byte: u8| byte.is_ascii_alphanumeric() || byte == b'-' || byte == b'_';
    !text.is_empty() && text.len() <= ID_MOST && text.bytes().all(fits)
}

/// An id, which is a text or a number.
#[derive(Deserialize)]
#[serde(untagged)]
enum Id {
    Text(String),
    Number(u64),
}

impl Id {
    fn checked(self) -> Result<String, String> {
        let id = match self {
            Self::Text(text) => text,
            Self::Number(number) => number.to_string(),
        };
        match is_id(&id) {
            true => Ok(id),
            false => Err("an action with an impossible id".to_string()),
        }
    }
}

/// The wish to cancel an action.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Cancel {
    /// The id of the wish itself.
    pub(super) id: String,
    /// The action that is to stop.
    pub(super) stop: String,
}

impl Cancel {
    pub(super) fn parse(body: &[u8]) -> Result<Self, String> {
        #[derive(Deserialize)]
        struct Stop {
            #[serde(rename = "stopId")]
            stop: Id,
        }
        #[derive(Deserialize)]
        struct Body {
            id: Id,
            #[serde(rename = "cancelAction")]
            cancel: Stop,
        }
        let Body { id, cancel } = read(body)?;
        Ok(Self { id: id.checked()?, stop: cancel.stop.checked()? })
    }
}

/// The state of an action.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Execution {
    Download,
    Downloaded,
    Proceeding,
    Resumed,
    Rejected,
    Closed,
}

/// How an action ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Finished {
    None,
    Success,
    Failure,
}

/// The lines that feedback has of these: no more, and none longer, than the server keeps.
pub(super) fn lines(details: &[String]) -> Vec<String> {
    let mut shown: Vec<String> =
        details.iter().take(LINES_MOST).map(|line| line.chars().take(LINE_MOST).collect()).collect();
    if let Some(over) = details.len().checked_sub(LINES_MOST).filter(|over| *over > 0) {
        shown.pop();
        shown.push(format!("and {} more lines, which the agent's own output has", over + 1));
    }
    shown
}

/// The body of feedback on an action.
pub(super) fn feedback(
    action: &str,
    execution: Execution,
    finished: Finished,
    percent: Option<u8>,
    details: &[String],
) -> serde_json::Value {
    let mut body = serde_json::json!({
        "id": action,
        "status": { "execution": execution, "result": { "finished": finished }, "details": lines(details) },
    });
    if let Some(percent) = percent {
        body["status"]["result"]["progress"] = serde_json::json!({ "cnt": percent, "of": 100 });
    }
    body
}

/// The body with a device's attributes.
pub(super) fn config_data(attributes: &[(String, String)]) -> serde_json::Value {
    let cut = |text: &String, most| text.chars().take(most).collect::<String>();
    let data: BTreeMap<String, String> =
        attributes.iter().map(|(key, value)| (cut(key, KEY_MOST), cut(value, VALUE_MOST))).collect();
    serde_json::json!({ "mode": "merge", "data": data })
}

fn read<'b, T: Deserialize<'b>>(body: &'b [u8]) -> Result<T, String> {
    serde_json::from_slice(body)
        .map_err(|error| format!("the server's answer is not what a hawkBit server sends: {error}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_root_resource_gives_pause_and_links() {
        let base = Base::parse(
            br#"{"config":{"polling":{"sleep":"12:01:30"}},"_links":{
                "deploymentBase":{"href":"https://h/T/controller/v1/d/deploymentBase/3?c=-21"},
                "configData":{"href":"https://h/T/controller/v1/d/configData"},
                "new":["what nobody knows"]}}"#,
        )
        .unwrap();
        assert_eq!(base.sleep, Some(Ok(Duration::from_secs(12 * 3600 + 90))));
        assert!(base.deployment.unwrap().ends_with("/3?c=-21") && base.config && base.cancel.is_none());
        for body in
            ["{}", r#"{"config":null}"#, r#"{"config":5}"#, r#"{"config":{"polling":{"sleep":null}}}"#]
        {
            assert_eq!(Base::parse(body.as_bytes()).unwrap(), Base::default(), "{body}");
        }
        for body in [&b""[..], b"[]", b"null", b"<html>", b"{\"_links\":5}", &[0xFF, 0xFE]] {
            assert!(Base::parse(body).is_err(), "{body:?}");
        }
        let deep = "[".repeat(100_000);
        assert!(Base::parse(deep.as_bytes()).is_err());
    }

    #[test]
    fn a_deployment_of_another_form_is_refused_and_what_is_unknown_is_left_alone() {
        let good = |id: &str, extra: &str| {
            format!(
                r#"{{"id":{id},"deployment":{{"download":"forced","update":"attempt",{extra}"chunks":[{{
                "part":"bApp","version":"1","name":"n","artifacts":[{{"filename":"a.blk","size":7,
                "hashes":{{"sha256":"{}"}},"_links":{{"download-http":{{"href":"http://h/a"}}}}}}]}}]}},
                "actionHistory":{{"status":"RUNNING"}}}}"#,
                "AB".repeat(32)
            )
        };
        let deployment = Deployment::parse(good("\"8\"", "").as_bytes()).unwrap();
        assert_eq!((deployment.action.as_str(), deployment.update), ("8", Handling::Attempt));
        let artifact = &deployment.chunks[0].artifacts[0];
        assert_eq!(artifact.sha256(), Some("ab".repeat(32)));
        assert_eq!((artifact.link(), artifact.size), (Some("http://h/a"), 7));
        assert!(!deployment.closed);
        for (window, closed) in [("available", false), ("unavailable", true), ("later", true)] {
            let text = good("8", &format!("\"maintenanceWindow\":\"{window}\","));
            assert_eq!(Deployment::parse(text.as_bytes()).unwrap().closed, closed, "{window}");
        }
        for id in ["\"\"", "\"../../x\"", "-5", "{}", "\"8\\r\\n\"", &format!("\"{}\"", "8".repeat(65))] {
            assert!(Deployment::parse(good(id, "").as_bytes()).is_err(), "{id}");
        }
        let many = format!(r#"{{"id":1,"deployment":{{"chunks":[{}{{}}]}}}}"#, "{},".repeat(64));
        assert!(Deployment::parse(many.as_bytes()).is_err());
        let cancel = Cancel::parse(br#"{"id":"11","cancelAction":{"stopId":"8"}}"#).unwrap();
        assert_eq!((cancel.id.as_str(), cancel.stop.as_str()), ("11", "8"));
    }

    #[test]
    fn feedback_keeps_to_the_servers_limits() {
        let lines = ["x".repeat(2000), "a line".to_string()];
        let body = feedback("8", Execution::Closed, Finished::Failure, None, &lines);
        assert_eq!(body["status"]["execution"], "closed");
        assert_eq!(body["status"]["result"], serde_json::json!({ "finished": "failure" }));
        assert_eq!(body["status"]["details"][0].as_str().unwrap().len(), 500);
        let many: Vec<String> = (0..60).map(|number| number.to_string()).collect();
        let body = feedback("8", Execution::Closed, Finished::Failure, None, &many);
        let shown = body["status"]["details"].as_array().unwrap();
        assert_eq!((shown.len(), shown[48].as_str().unwrap()), (50, "48"));
        assert!(shown[49].as_str().unwrap().starts_with("and 11 more lines"));
        let body = feedback("8", Execution::Closed, Finished::Failure, None, &many[..50]);
        assert_eq!(body["status"]["details"][49], "49");
        let body = feedback("8", Execution::Proceeding, Finished::None, Some(40), &[]);
        assert_eq!(body["status"]["result"]["progress"], serde_json::json!({ "cnt": 40, "of": 100 }));
        let data = config_data(&[("k".repeat(50), "v".repeat(500))]);
        assert_eq!(data["data"]["k".repeat(32)].as_str().unwrap().len(), 128);
    }
}
