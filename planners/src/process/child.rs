//! The process, and the thread that talks to it.

use std::io::{BufWriter, ErrorKind, Read, Write};
use std::process::{Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use arrow::array::RecordBatch;
use arrow::datatypes::SchemaRef;
use arrow::error::ArrowError;
use arrow::ipc::writer::StreamWriter;

use super::error::{ProcessError, ProcessErrorKind};
use super::frames::{FrameError, Frames};
use super::protocol::{self, Setting};
use crate::planner::PlannerSpec;

/// Bytes of stderr that are kept.
const KEPT: usize = 2000;
/// Time that a process has to end by itself once its stdin is closed, or to say its last words.
const GRACE: Duration = Duration::from_millis(500);
/// Time between two looks whether it has.
const TICK: Duration = Duration::from_millis(5);

/// What the thread hands on.
enum Answer {
    /// The schema of the process, after its first batch.
    Hello(SchemaRef),
    /// What it answered.
    Batch(RecordBatch),
}

/// A running planner process.
#[derive(Debug)]
pub(super) struct Child {
    command: String,
    process: std::process::Child,
    /// `None` once it is to end.
    asks: Option<Sender<RecordBatch>>,
    answers: Receiver<Result<Answer, FrameError>>,
    said: Arc<Mutex<Vec<u8>>>,
    /// Closed when stderr is.
    said_all: Receiver<()>,
}

impl Child {
    /// Starts the command and sends it the setting.
    pub(super) fn start(command: &str, setting: &Setting) -> Result<Self, ProcessError> {
        let fail = |kind| ProcessError {
            command: command.to_owned(),
            kind,
            said: String::new(),
        };
        let words = shlex::split(command).filter(|words| !words.is_empty());
        let words = words.ok_or_else(|| fail(ProcessErrorKind::Command))?;
        let mut process = Command::new(&words[0])
            .args(&words[1..])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(|error| fail(ProcessErrorKind::Start(error)))?;
        let pipes = (
            process.stdin.take(),
            process.stdout.take(),
            process.stderr.take(),
        );
        let (Some(stdin), Some(stdout), Some(stderr)) = pipes else {
            let error = std::io::Error::other("it has no pipes");
            return Err(fail(ProcessErrorKind::Start(error)));
        };
        let schema = protocol::request_schema(setting);
        let (asks, asked) = channel();
        let (answer, answers) = channel();
        thread::spawn(move || {
            if let Err(error) = talk(stdin, stdout, &schema, &asked, &answer) {
                // Nobody listens any more: nothing to tell.
                let _ = answer.send(Err(error));
            }
        });
        let said = Arc::new(Mutex::new(Vec::new()));
        let (saying, said_all) = channel();
        let keep = Arc::clone(&said);
        thread::spawn(move || {
            listen(stderr, &keep);
            drop(saying);
        });
        Ok(Self {
            command: command.to_owned(),
            process,
            asks: Some(asks),
            answers,
            said,
            said_all,
        })
    }

    /// Waits for the answer to the setting.
    pub(super) fn handshake(&mut self, limit: Duration) -> Result<PlannerSpec, ProcessError> {
        match self.wait(limit)? {
            Answer::Hello(schema) => protocol::spec_of(&schema).map_err(|kind| self.error(kind)),
            Answer::Batch(_) => Err(self.error(ProcessErrorKind::Over)),
        }
    }

    /// Sends a message and waits for its answer.
    pub(super) fn ask(
        &mut self,
        message: Result<RecordBatch, ArrowError>,
        limit: Duration,
    ) -> Result<RecordBatch, ProcessError> {
        let message = message.map_err(|error| self.error(error.into()))?;
        let Some(asks) = &self.asks else {
            return Err(self.error(ProcessErrorKind::Over));
        };
        // If the thread is gone, its last word tells why.
        let _ = asks.send(message);
        match self.wait(limit)? {
            Answer::Batch(batch) => Ok(batch),
            Answer::Hello(_) => Err(self.error(ProcessErrorKind::Over)),
        }
    }

    /// An error with what was said on stderr so far.
    pub(super) fn error(&self, kind: ProcessErrorKind) -> ProcessError {
        let said = self.said.lock().unwrap_or_else(PoisonError::into_inner);
        ProcessError {
            command: self.command.clone(),
            kind,
            said: String::from_utf8_lossy(&said).into_owned(),
        }
    }

    fn wait(&mut self, limit: Duration) -> Result<Answer, ProcessError> {
        let kind = match self.answers.recv_timeout(limit) {
            Ok(Ok(answer)) => return Ok(answer),
            Ok(Err(FrameError::Kind(kind))) => kind,
            Ok(Err(FrameError::Cut)) => {
                let status = self.status();
                ProcessErrorKind::Cut { status }
            }
            Ok(Err(FrameError::Ended)) | Err(RecvTimeoutError::Disconnected) => {
                let status = self.status();
                ProcessErrorKind::Ended { status }
            }
            Err(RecvTimeoutError::Timeout) => ProcessErrorKind::Timeout { limit },
        };
        self.end();
        Err(self.error(kind))
    }

    /// How it ended, if it has or does so shortly.
    fn status(&mut self) -> String {
        match self.is_over_within(GRACE) {
            Some(status) => status.to_string(),
            None => "with its stdout closed, still running".to_owned(),
        }
    }

    fn is_over_within(&mut self, limit: Duration) -> Option<std::process::ExitStatus> {
        let until = Instant::now() + limit;
        loop {
            match self.process.try_wait() {
                Ok(Some(status)) => return Some(status),
                Ok(None) if Instant::now() < until => thread::sleep(TICK),
                _ => return None,
            }
        }
    }

    /// Ends the process and hears what it said.
    fn end(&mut self) {
        self.asks = None;
        // An error means that it is over already.
        let _ = self.process.kill();
        let _ = self.process.wait();
        // Disconnected at the end of stderr; a child of its own may hold it open for longer.
        let _ = self.said_all.recv_timeout(GRACE);
    }
}

impl Drop for Child {
    fn drop(&mut self) {
        // Closes its stdin, unless the thread waits for an answer.
        if self.asks.take().is_some() {
            let _ = self.is_over_within(GRACE);
        }
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// Sends what is asked and hands on what is answered, until nobody asks.
fn talk(
    stdin: impl Write,
    stdout: impl Read,
    schema: &SchemaRef,
    asks: &Receiver<RecordBatch>,
    answers: &Sender<Result<Answer, FrameError>>,
) -> Result<(), FrameError> {
    let writer = StreamWriter::try_new(BufWriter::new(stdin), schema);
    let writer = writer.and_then(|mut writer| {
        writer.flush()?;
        Ok(writer)
    });
    let Some(mut writer) = unless_closed(writer)? else {
        // Its last words on stdout tell more than that it does not listen.
        return Err(Frames::new(stdout).err().unwrap_or(FrameError::Ended));
    };
    let (mut frames, schema) = Frames::new(stdout)?;
    let hello = frames.batch()?;
    if hello.num_rows() > 0 {
        return Err(ProcessErrorKind::Rows {
            of: "handshake",
            expected: "no rows".to_owned(),
            found: hello.num_rows(),
        }
        .into());
    }
    let mut heard = answers.send(Ok(Answer::Hello(schema))).is_ok();
    while heard {
        let Ok(ask) = asks.recv() else {
            break;
        };
        let written = writer.write(&ask).and_then(|()| writer.flush());
        if unless_closed(written)?.is_none() {
            return Err(frames.batch().err().unwrap_or(FrameError::Ended));
        }
        heard = answers.send(Ok(Answer::Batch(frames.batch()?))).is_ok();
    }
    unless_closed(writer.finish()).map(drop)
}

/// `None` where the process does not read any more.
fn unless_closed<T>(written: Result<T, ArrowError>) -> Result<Option<T>, FrameError> {
    match written {
        Ok(value) => Ok(Some(value)),
        Err(ArrowError::IoError(_, source)) if source.kind() == ErrorKind::BrokenPipe => Ok(None),
        Err(error) => Err(ProcessErrorKind::Arrow(error).into()),
    }
}

/// Keeps the end of what is said.
fn listen(mut stderr: impl Read, said: &Mutex<Vec<u8>>) {
    let mut chunk = [0; 1024];
    while let Ok(n @ 1..) = stderr.read(&mut chunk) {
        let mut said = said.lock().unwrap_or_else(PoisonError::into_inner);
        said.extend_from_slice(&chunk[..n]);
        let surplus = said.len().saturating_sub(KEPT);
        said.drain(..surplus);
    }
}
