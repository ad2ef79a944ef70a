//! One file: attempts, going on where one broke off, checks.

use std::fs::File;
use std::io::{Read, Write};

use super::error::DownloadError;
use super::http::{Answer, Client, Failure, Retries};
use super::partial::{Mark, Partial, sha256};
use super::{DownloadOptions, Event};

/// An attempt that brought this much is worth a fresh row of retries.
const PROGRESS: u64 = 1 << 20;

/// A file to fetch.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Wanted {
    pub(super) url: String,
    pub(super) bytes: Option<u64>,
    /// Lower-case hexadecimal.
    pub(super) sha256: Option<String>,
}

/// Who wants to know, and what the bytes of this file are added to.
pub(super) struct Watch<'a> {
    pub(super) event: &'a mut dyn FnMut(Event),
    /// Bytes of the files before.
    pub(super) before: u64,
    /// Bytes of all files, where known.
    pub(super) total: Option<u64>,
    /// Bytes that came over the network.
    pub(super) fetched: u64,
}

/// Fetches a file into `current`, complete and checked as far as it can be.
pub(super) fn fetch(
    client: &Client<'_>,
    options: &DownloadOptions,
    wanted: &Wanted,
    partial: &Partial,
    watch: &mut Watch<'_>,
) -> Result<(), DownloadError> {
    let mut retries = Retries::new(options);
    let mut may_start_over = true;
    loop {
        let before = watch.fetched;
        let mut attempt = Attempt {
            client,
            options,
            wanted,
            partial,
            watch,
            resumed: false,
        };
        let ended = attempt.run();
        let resumed = attempt.resumed;
        if watch.fetched - before >= PROGRESS {
            retries.made_progress();
        }
        match ended {
            Err(failure) => retries.wait(failure, watch.event)?,
            Ok(()) => match check(wanted, partial) {
                // The beginning may have been of another file: once, try without it.
                Err(_) if resumed && may_start_over => may_start_over = false,
                checked => return checked,
            },
        }
    }
}

/// Compares with what was published; what differs is dropped.
fn check(wanted: &Wanted, partial: &Partial) -> Result<(), DownloadError> {
    let Some(expected) = &wanted.sha256 else {
        return Ok(());
    };
    let found = sha256(&partial.current())?;
    if found == *expected {
        return Ok(());
    }
    partial.discard();
    Err(DownloadError::Checksum {
        found,
        expected: expected.clone(),
    })
}

struct Attempt<'a, 'w> {
    client: &'a Client<'a>,
    options: &'a DownloadOptions,
    wanted: &'a Wanted,
    partial: &'a Partial,
    watch: &'a mut Watch<'w>,
    /// Whether it went on from an earlier beginning.
    resumed: bool,
}

impl Attempt<'_, '_> {
    fn run(&mut self) -> Result<(), Failure> {
        let begun = self.begun();
        let mut headers = Vec::new();
        if let Some((mark, have)) = &begun {
            if mark.total == Some(*have) {
                self.resumed = true;
                return Ok(());
            }
            headers.push(("Range", format!("bytes={have}-")));
            headers.extend(
                mark.validator()
                    .map(|validator| ("If-Range", validator.clone())),
            );
        }
        let answer = self.client.get(&self.wanted.url, &headers)?;
        self.check_content(&answer)?;
        match (answer.status, begun) {
            (206, Some((mark, have))) => self.proceed(answer, &mark, have),
            (200, _) => self.start(answer),
            (status, _) => {
                // 416: the beginning is longer than the file. 206 unasked: not to be trusted.
                self.partial.discard();
                Err(Failure::passing(format!(
                    "the server answers {status} to a range"
                )))
            }
        }
    }

    /// A beginning one can go on from: of the same file, with a way to tell that it still is.
    fn begun(&self) -> Option<(Mark, u64)> {
        let (mark, have) = self.partial.mark()?;
        let is_same = mark.url == self.wanted.url
            && mark.sha256 == self.wanted.sha256
            && (self.wanted.bytes.is_none() || mark.total == self.wanted.bytes);
        let can_tell = mark.validator().is_some() || mark.sha256.is_some();
        let fits = mark.total.is_none_or(|total| have <= total);
        (is_same && can_tell && fits && have > 0).then_some((mark, have))
    }

    /// Refuses error pages and packed bodies.
    fn check_content(&self, answer: &Answer) -> Result<(), DownloadError> {
        let expected = "the file itself";
        let kind = answer.header("content-type").unwrap_or_default();
        if answer.status != 416 && kind.to_ascii_lowercase().starts_with("text/html") {
            let found = "a web page (text/html)".to_owned();
            return Err(DownloadError::WrongContent { found, expected });
        }
        match answer.header("content-encoding") {
            None | Some("identity" | "") => Ok(()),
            Some(encoding) => {
                let found = format!("it packed as \"{}\"", encoding.escape_debug());
                Err(DownloadError::WrongContent { found, expected })
            }
        }
    }

    fn start(&mut self, answer: Answer) -> Result<(), Failure> {
        let declared = answer.content_length();
        if let (Some(found), Some(expected)) = (declared, self.wanted.bytes)
            && found != expected
        {
            return Err(DownloadError::Size { found, expected }.into());
        }
        let header = |name| answer.header(name).map(str::to_owned);
        let mark = Mark {
            url: self.wanted.url.clone(),
            etag: header("etag"),
            last_modified: header("last-modified"),
            total: self.wanted.bytes.or(declared),
            sha256: self.wanted.sha256.clone(),
        };
        self.check_limit(mark.total.unwrap_or(0))?;
        let file = self.partial.restart(&mark)?;
        self.copy(answer, file, 0, mark.total)
    }

    fn proceed(&mut self, answer: Answer, mark: &Mark, have: u64) -> Result<(), Failure> {
        let range = answer.header("content-range").and_then(content_range);
        let fits = range.is_some_and(|(start, total)| {
            start == have && (total.is_none() || mark.total.is_none() || total == mark.total)
        });
        if !fits {
            self.partial.discard();
            return Err(Failure::passing(
                "the server sent another range than asked for",
            ));
        }
        self.resumed = true;
        let total = mark.total.or(range.and_then(|(_, total)| total));
        let file = self.partial.proceed()?;
        self.copy(answer, file, have, total)
    }

    /// The body to the end of the file, never beyond what the file should have.
    fn copy(
        &mut self,
        answer: Answer,
        mut file: File,
        mut have: u64,
        total: Option<u64>,
    ) -> Result<(), Failure> {
        let mut reader = answer.reader();
        let mut buffer = vec![0; 1 << 16];
        loop {
            self.tell(have, total);
            let n = reader
                .read(&mut buffer)
                .map_err(|error| Failure::passing(broken_off(&error, have, total)))?;
            if n == 0 {
                break;
            }
            have += n as u64;
            self.watch.fetched += n as u64;
            if let Some(expected) = total
                && have > expected
            {
                self.partial.discard();
                let found = have;
                return Err(DownloadError::Size { found, expected }.into());
            }
            self.check_limit(have)?;
            file.write_all(&buffer[..n])
                .map_err(DownloadError::disk("write the partial file"))?;
        }
        match total {
            Some(expected) if have < expected => Err(Failure::passing(format!(
                "the connection ended after {have} of {expected} bytes"
            ))),
            _ => Ok(()),
        }
    }

    fn check_limit(&self, bytes: u64) -> Result<(), DownloadError> {
        let found = self.watch.before.saturating_add(bytes);
        let limit = self.options.max_bytes;
        match found > limit {
            true => Err(DownloadError::TooLarge { found, limit }),
            false => Ok(()),
        }
    }

    fn tell(&mut self, have: u64, total: Option<u64>) {
        let (done, total) = (self.watch.before + have, self.watch.total.or(total));
        (self.watch.event)(Event::Bytes { done, total });
    }
}

fn broken_off(error: &std::io::Error, have: u64, total: Option<u64>) -> String {
    let of = total.map_or_else(String::new, |total| format!(" of {total}"));
    format!("the connection broke off after {have}{of} bytes ({error})")
}

/// Start and total of `bytes 5-9/10`.
fn content_range(header: &str) -> Option<(u64, Option<u64>)> {
    let (range, total) = header.strip_prefix("bytes ")?.split_once('/')?;
    let (start, _) = range.split_once('-')?;
    let total = match total {
        "*" => None,
        total => Some(total.parse().ok()?),
    };
    Some((start.parse().ok()?, total))
}
