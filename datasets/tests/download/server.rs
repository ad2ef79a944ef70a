//! A small HTTP server that answers as it is told, on this machine only.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex};

/// A request, as far as tests look at it.
#[derive(Debug, Clone)]
pub(crate) struct Request {
    /// Path and query.
    pub(crate) path: String,
    headers: Vec<(String, String)>,
}

impl Request {
    /// A header by its lower-case name.
    pub(crate) fn header(&self, name: &str) -> Option<&str> {
        let found = self.headers.iter().find(|(known, _)| known == name);
        found.map(|(_, value)| value.as_str())
    }

    /// Start of the range that is asked for.
    pub(crate) fn range_start(&self) -> Option<usize> {
        let range = self.header("range")?.strip_prefix("bytes=")?;
        range.strip_suffix('-')?.parse().ok()
    }
}

/// What to answer.
#[derive(Debug, Clone)]
pub(crate) struct Reply {
    status: u16,
    headers: Vec<(String, String)>,
    body: Vec<u8>,
    declared: Option<usize>,
    stalls: bool,
}

impl Reply {
    /// A status with a body that is declared as it is.
    pub(crate) fn new(status: u16, body: impl Into<Vec<u8>>) -> Self {
        let body = body.into();
        Self {
            status,
            headers: Vec::new(),
            declared: Some(body.len()),
            body,
            stalls: false,
        }
    }

    /// 200 with a body.
    pub(crate) fn ok(body: impl Into<Vec<u8>>) -> Self {
        Self::new(200, body)
    }

    /// What a well-behaved server answers: the asked range as long as the tag is the same.
    pub(crate) fn file(request: &Request, tag: &str, bytes: &[u8]) -> Self {
        let is_same = request.header("if-range").is_none_or(|asked| asked == tag);
        let reply = match request.range_start().filter(|_| is_same) {
            Some(start) => {
                let range = format!("bytes {start}-{}/{}", bytes.len() - 1, bytes.len());
                Self::new(206, &bytes[start..]).header("Content-Range", &range)
            }
            None => Self::ok(bytes),
        };
        reply.header("ETag", tag)
    }

    /// Adds a header.
    pub(crate) fn header(mut self, name: &str, value: &str) -> Self {
        self.headers.push((name.to_owned(), value.to_owned()));
        self
    }

    /// Declares another length than the body has, or none.
    pub(crate) fn declaring(mut self, length: Option<usize>) -> Self {
        self.declared = length;
        self
    }

    /// Sends only the beginning of the body, then drops the connection.
    pub(crate) fn cut_to(mut self, length: usize) -> Self {
        self.body.truncate(length);
        self
    }

    /// Sends nothing more after the body, but keeps the connection.
    pub(crate) fn stalling(mut self) -> Self {
        self.stalls = true;
        self
    }

    fn send(&self, mut stream: TcpStream) -> std::io::Result<()> {
        let mut head = format!("HTTP/1.1 {} X\r\nConnection: close\r\n", self.status);
        for (name, value) in &self.headers {
            head.push_str(&format!("{name}: {value}\r\n"));
        }
        if let Some(declared) = self.declared {
            head.push_str(&format!("Content-Length: {declared}\r\n"));
        }
        head.push_str("\r\n");
        stream.write_all(head.as_bytes())?;
        stream.write_all(&self.body)?;
        stream.flush()?;
        if self.stalls {
            // Until the client has had enough.
            stream.read_to_end(&mut Vec::new())?;
        }
        Ok(())
    }
}

/// The server, and what it was asked.
pub(crate) struct Server {
    /// Its address, such as `http://127.0.0.1:1234`.
    pub(crate) url: String,
    asked: Arc<Mutex<Vec<Request>>>,
}

impl Server {
    /// Answers each request by the function, which also gets the number of requests before.
    pub(crate) fn start(mut answer: impl FnMut(&Request, usize) -> Reply + Send + 'static) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let url = format!("http://{}", listener.local_addr().expect("an address"));
        let asked = Arc::new(Mutex::new(Vec::new()));
        let log = Arc::clone(&asked);
        std::thread::spawn(move || {
            for stream in listener.incoming() {
                let Some((request, stream)) = stream.ok().and_then(read) else {
                    continue;
                };
                let n_before = {
                    let mut log = log.lock().expect("no panic");
                    log.push(request.clone());
                    log.len() - 1
                };
                // A client that hangs up early is part of some tests.
                let _ = answer(&request, n_before).send(stream);
            }
        });
        Self { url, asked }
    }

    /// All requests so far.
    pub(crate) fn asked(&self) -> Vec<Request> {
        self.asked.lock().expect("no panic").clone()
    }
}

fn read(stream: TcpStream) -> Option<(Request, TcpStream)> {
    let mut reader = BufReader::new(stream);
    let mut line = String::new();
    reader.read_line(&mut line).ok()?;
    let path = line.split(' ').nth(1)?.to_owned();
    let mut headers = Vec::new();
    loop {
        let mut line = String::new();
        reader.read_line(&mut line).ok()?;
        let Some((name, value)) = line.trim_end().split_once(':') else {
            break;
        };
        headers.push((name.to_ascii_lowercase(), value.trim().to_owned()));
    }
    Some((Request { path, headers }, reader.into_inner()))
}
