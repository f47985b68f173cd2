//! The dialect `raw`: CiA 302-3 with an image of the program from its start.

use super::cia302;
use super::procedure::{Downloaded, Procedure};
use crate::device::{DeviceType, Dialect, Error, Session};
use crate::file::BlockFile;
use crate::update::content::Content;
use crate::update::options::FlashOptions;
use crate::update::running::RunningUpdate;

/// See the [module](self).
pub(super) struct Raw;

impl Procedure for Raw {
    fn enter(
        &self,
        session: &mut Session<'_>,
        running: DeviceType,
        options: &FlashOptions,
        update: &mut RunningUpdate<'_>,
    ) -> Result<Dialect, Error> {
        cia302::enter(session, running, Dialect::Raw, options.program, update)
    }

    fn download(
        &self,
        session: &mut Session<'_>,
        file: Content<'_>,
        options: &FlashOptions,
        update: &mut RunningUpdate<'_>,
    ) -> Result<Downloaded, Error> {
        let content = file.stream(BlockFile::flash_image);
        cia302::download(session, &content, file.program_crcs(), options, update)
    }
}
