//! `coflash ui`: the page in the browser.

use clap::Args;
use coflash_ui::{Options, Server};
use serde_json::json;

use super::context::Context;
use super::device::cancelled;
use super::output::Failure;

/// Serves a page for the browser to this computer only: scan, update, LSS and the bus in words.
///
/// The command prints the URL of the page, which contains a random token: anyone with the URL can
/// do everything that the page offers. Ctrl-C ends the command; a running update is ended in an
/// orderly way.
#[derive(Debug, Args)]
pub(super) struct Ui {
    /// The port on 127.0.0.1; by default a free one.
    #[arg(long, value_name = "PORT", default_value = "0", hide_default_value = true)]
    port: u16,

    /// Print the URL without opening a browser.
    #[arg(long)]
    no_open: bool,
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
        options.sdo_ids = match (context.sdo_request, context.sdo_response) {
            (None, None) => None,
            (request, response) => Some((request.unwrap_or(0x600), response.unwrap_or(0x580))),
        };
        let server = Server::new(options).map_err(|error| {
            Failure::system(format!("port {} of 127.0.0.1 cannot be served: {error}", self.port))
        })?;
        let url = server.url();
        context
            .out
            .result(format_args!("{url}  (Ctrl-C ends it)"), || json!({ "command": "ui", "url": url }));
        if !self.no_open && open::that_detached(&url).is_err() {
            context.out.warn("no browser was found: open the URL yourself");
        }
        let left = server
            .run(&end)
            .map_err(|error| Failure::system(format!("the page cannot be served: {error}")))?;
        match left {
            Some(words) => context.out.warn(format_args!("an update was running: {words}")),
            None => context.out.say("the page has ended"),
        }
        Ok(())
    }
}
