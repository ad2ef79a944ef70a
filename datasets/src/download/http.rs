//! Requests: redirections, which failures pass, how long to wait.

use std::cell::Cell;
use std::io::{self, Read};
use std::time::Duration;

use ureq::http::{HeaderMap, Uri};
use ureq::{Agent, Body, Proxy};

use super::error::DownloadError;
use super::{DownloadOptions, Event};

/// Redirections that are followed for one request.
const MAX_REDIRECTS: usize = 10;

/// How an attempt failed.
pub(super) enum Failure {
    /// It may pass.
    Passing {
        what: String,
        /// How long the server asks to wait.
        wait: Option<Duration>,
    },
    /// Trying again will not help.
    Final(DownloadError),
}

impl From<DownloadError> for Failure {
    fn from(error: DownloadError) -> Self {
        Self::Final(error)
    }
}

impl Failure {
    pub(super) fn passing(what: impl Into<String>) -> Self {
        Self::Passing {
            what: what.into(),
            wait: None,
        }
    }
}

/// An answer whose status is a success, or 416.
pub(super) struct Answer {
    pub(super) status: u16,
    headers: HeaderMap,
    body: Body,
}

impl Answer {
    pub(super) fn header(&self, name: &str) -> Option<&str> {
        self.headers.get(name)?.to_str().ok().map(str::trim)
    }

    pub(super) fn content_length(&self) -> Option<u64> {
        self.header("content-length")?.parse().ok()
    }

    /// The body; it ends where the server says, however long that is.
    pub(super) fn reader(self) -> impl Read {
        self.body.into_with_config().limit(u64::MAX).reader()
    }
}

/// Sends requests.
pub(super) struct Client<'a> {
    agent: Agent,
    options: &'a DownloadOptions,
    /// Whether the user asked for an unencrypted server.
    allow_plain: bool,
    /// Whether any server has answered: if not, a failed connection means there is no network.
    reached: Cell<bool>,
}

impl<'a> Client<'a> {
    pub(super) fn new(options: &'a DownloadOptions, base: &str) -> Self {
        let mut config = Agent::config_builder()
            .http_status_as_error(false)
            .max_redirects(0)
            .max_redirects_will_error(false)
            .user_agent(concat!("ksim/", env!("CARGO_PKG_VERSION")))
            // What is stored is the file itself, not a packed form of it.
            .accept_encoding("identity")
            .timeout_resolve(Some(options.connect_timeout))
            .timeout_connect(Some(options.connect_timeout))
            .timeout_recv_response(Some(options.stall_timeout))
            .timeout_per_read(Some(options.stall_timeout));
        config = match options.use_proxy {
            true => config.proxy(Proxy::try_from_env()),
            false => config.proxy(None),
        };
        Self {
            agent: config.build().new_agent(),
            options,
            allow_plain: base.starts_with("http://"),
            reached: Cell::new(false),
        }
    }

    /// One request, redirections followed.
    pub(super) fn get(&self, url: &str, headers: &[(&str, String)]) -> Result<Answer, Failure> {
        let mut url = url.to_owned();
        for _ in 0..=MAX_REDIRECTS {
            let mut request = self.agent.get(&url);
            for (name, value) in headers {
                request = request.header(*name, value);
            }
            let response = request.call().map_err(|error| self.failure(error))?;
            self.reached.set(true);
            let (parts, body) = response.into_parts();
            let answer = Answer {
                status: parts.status.as_u16(),
                headers: parts.headers,
                body,
            };
            match answer.status {
                200 | 206 | 416 => return Ok(answer),
                301 | 302 | 303 | 307 | 308 => url = self.redirected(&url, &answer)?,
                status => return Err(self.refusal(status, &answer)),
            }
        }
        Err(DownloadError::Redirect {
            to: url,
            reason: "too many redirections",
        }
        .into())
    }

    fn redirected(&self, from: &str, answer: &Answer) -> Result<String, DownloadError> {
        let location = answer.header("location").unwrap_or_default();
        let refused = |reason| DownloadError::Redirect {
            to: location.escape_debug().to_string(),
            reason,
        };
        let to = join(from, location).ok_or_else(|| refused("it is no http or https address"))?;
        if from.starts_with("https:") && to.starts_with("http:") && !self.allow_plain {
            return Err(refused("it leaves the encrypted connection"));
        }
        Ok(to)
    }

    fn refusal(&self, status: u16, answer: &Answer) -> Failure {
        if !matches!(status, 408 | 425 | 429 | 500..=599) {
            return DownloadError::status(status).into();
        }
        let wait = answer.header("retry-after").and_then(|s| s.parse().ok());
        match wait.map(Duration::from_secs) {
            Some(wait) if wait > self.options.max_wait => {
                DownloadError::asked_to_wait(status, wait).into()
            }
            wait => Failure::Passing {
                what: format!("the server answers {status}"),
                wait,
            },
        }
    }

    fn failure(&self, error: ureq::Error) -> Failure {
        use ureq::Timeout;
        let what = error.to_string();
        let is_connecting = match &error {
            ureq::Error::HostNotFound | ureq::Error::ConnectionFailed => true,
            ureq::Error::Timeout(timeout) => matches!(timeout, Timeout::Resolve | Timeout::Connect),
            ureq::Error::Io(error) => is_connecting(error),
            _ => false,
        };
        match error {
            _ if is_connecting && !self.reached.get() => DownloadError::Offline { what }.into(),
            _ if is_connecting => Failure::passing(what),
            ureq::Error::Timeout(_) | ureq::Error::BodyStalled => Failure::passing(what),
            ureq::Error::Io(error) if is_passing(&error) => Failure::passing(what),
            _ => DownloadError::Connection { what }.into(),
        }
    }
}

/// Errors of the system that say that there is no way to the server.
fn is_connecting(error: &io::Error) -> bool {
    use io::ErrorKind::{
        AddrNotAvailable, ConnectionRefused, HostUnreachable, NetworkDown, NetworkUnreachable,
    };
    matches!(
        error.kind(),
        ConnectionRefused | HostUnreachable | NetworkUnreachable | NetworkDown | AddrNotAvailable
    ) || error.to_string().contains("lookup address")
}

/// Errors of the system that say that a connection was lost.
fn is_passing(error: &io::Error) -> bool {
    use io::ErrorKind::{
        BrokenPipe, ConnectionAborted, ConnectionReset, Interrupted, TimedOut, UnexpectedEof,
        WouldBlock,
    };
    matches!(
        error.kind(),
        BrokenPipe
            | ConnectionAborted
            | ConnectionReset
            | Interrupted
            | TimedOut
            | UnexpectedEof
            | WouldBlock
    )
}

/// Where a `Location` leads, seen from an address.
fn join(from: &str, location: &str) -> Option<String> {
    let uri: Uri = from.parse().ok()?;
    let (scheme, authority) = (uri.scheme_str()?, uri.authority()?);
    let to = if location.starts_with("http://") || location.starts_with("https://") {
        location.to_owned()
    } else if let Some(rest) = location.strip_prefix("//") {
        format!("{scheme}://{rest}")
    } else if location.starts_with('/') {
        format!("{scheme}://{authority}{location}")
    } else if location.is_empty() || location.split('/').next()?.contains(':') {
        return None;
    } else {
        let folder = uri.path().rsplit_once('/').map_or("", |(folder, _)| folder);
        format!("{scheme}://{authority}{folder}/{location}")
    };
    to.parse::<Uri>().ok().map(|_| to)
}

/// Attempts in a row that brought nothing.
pub(super) struct Retries<'a> {
    options: &'a DownloadOptions,
    failed: u32,
}

impl<'a> Retries<'a> {
    pub(super) fn new(options: &'a DownloadOptions) -> Self {
        Self { options, failed: 0 }
    }

    /// Something came: the next failure is the first again.
    pub(super) fn made_progress(&mut self) {
        self.failed = 0;
    }

    /// Waits before the next attempt.
    ///
    /// # Errors
    /// The failure is final, or one too many.
    pub(super) fn wait(
        &mut self,
        failure: Failure,
        event: &mut dyn FnMut(Event),
    ) -> Result<(), DownloadError> {
        let (what, asked) = match failure {
            Failure::Passing { what, wait } => (what, wait),
            Failure::Final(error) => return Err(error),
        };
        self.failed += 1;
        if self.failed > self.options.max_retries {
            return Err(DownloadError::GaveUp {
                attempts: self.failed,
                what,
            });
        }
        let doubled = self.options.retry_delay * 2_u32.saturating_pow(self.failed - 1).min(1 << 16);
        let wait = asked.unwrap_or(doubled).min(self.options.max_wait);
        event(Event::Retry { what, wait });
        std::thread::sleep(wait);
        Ok(())
    }
}

/// The whole of a small answer, at most `limit` bytes; `None` if there is no such file.
pub(super) fn get_small(
    client: &Client<'_>,
    url: &str,
    limit: u64,
    event: &mut dyn FnMut(Event),
) -> Result<Option<Small>, DownloadError> {
    let mut retries = Retries::new(client.options);
    loop {
        match small(client, url, limit) {
            Ok(small) => return Ok(Some(small)),
            Err(Failure::Final(DownloadError::Status { status: 404, .. })) => return Ok(None),
            Err(failure) => retries.wait(failure, event)?,
        }
    }
}

/// A small answer.
pub(super) struct Small {
    pub(super) bytes: Vec<u8>,
    /// The `Link` header.
    pub(super) link: Option<String>,
}

fn small(client: &Client<'_>, url: &str, limit: u64) -> Result<Small, Failure> {
    let answer = client.get(url, &[])?;
    let link = answer.header("link").map(str::to_owned);
    let declared = answer.content_length();
    let mut bytes = Vec::new();
    answer
        .reader()
        .take(limit + 1)
        .read_to_end(&mut bytes)
        .map_err(|error| Failure::passing(error.to_string()))?;
    let found = bytes.len() as u64;
    if found > limit {
        return Err(DownloadError::TooLarge { found, limit }.into());
    }
    match declared {
        Some(declared) if found < declared => Err(Failure::passing(format!(
            "the connection ended after {found} of {declared} bytes"
        ))),
        _ => Ok(Small { bytes, link }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn locations_are_seen_from_the_address() {
        let join = |location| join("https://a.b:8/c/d?x=1", location);
        assert_eq!(join("https://e/f").as_deref(), Some("https://e/f"));
        assert_eq!(join("//e/f").as_deref(), Some("https://e/f"));
        assert_eq!(join("/f?y").as_deref(), Some("https://a.b:8/f?y"));
        assert_eq!(join("f").as_deref(), Some("https://a.b:8/c/f"));
        for bad in [
            "",
            "file:///etc/passwd",
            "javascript:x",
            "https://",
            "http://a b/",
        ] {
            assert_eq!(join(bad), None, "{bad}");
        }
    }

    #[test]
    fn an_encrypted_connection_is_not_left() {
        let options = DownloadOptions::default();
        let answer = |location: &str| {
            let mut headers = HeaderMap::new();
            headers.insert("location", location.parse().unwrap());
            Answer {
                status: 302,
                headers,
                body: Body::builder().data(""),
            }
        };
        let from = "https://a/x";
        let client = Client::new(&options, "https://a");
        let refused = client.redirected(from, &answer("http://a/y")).unwrap_err();
        assert!(refused.to_string().contains("encrypted"), "{refused}");
        assert!(client.redirected(from, &answer("https://b/y")).is_ok());
        let client = Client::new(&options, "http://a");
        assert!(client.redirected(from, &answer("http://a/y")).is_ok());
    }
}
