//! The dialect `raw`: CiA 302-3 with an image of the program from its start.

use super::cia302;
use super::procedure::{Downloaded, Procedure};
use crate::device::{DeviceType, Dialect, Error, Session};
use crate::file::BlockFile;
use crate::update::content::Content;
use crate::update::course::Course;
use crate::update::options::FlashOptions;

/// See the [module](self).
pub(super) struct Raw;

impl Procedure for Raw {
    fn enter(
        &self,
        session: &mut Session<'_>,
        running: DeviceType,
        options: &FlashOptions,
        course: &mut Course<'_>,
    ) -> Result<Dialect, Error> {
        cia302::enter(session, running, Dialect::Raw, options.program, course)
    }

    fn download(
        &self,
        session: &mut Session<'_>,
        file: Content<'_>,
        options: &FlashOptions,
        course: &mut Course<'_>,
    ) -> Result<Downloaded, Error> {
        let content = file.stream(BlockFile::flash_image);
        cia302::download(session, &content, file.program_crc(), options, course)
    }
}
