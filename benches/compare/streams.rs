//! Unix stream sockets, TCP and pipes: one connection to each receiver, one write to each of them for a message. Every
//! message is of the same length, so that a receiver asks for no more than is its own, with one read if it can.

use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::os::fd::OwnedFd;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::Path;

use rustix::fs::{CWD, FileType, Mode, mknodat};
use rustix::pipe::fcntl_setpipe_size;

use super::message::{Draft, Label};
use super::receiver::Inlet;
use super::sender::{Outlet, Task};
use super::way::Way;
use crate::support::Outcome;

/// The sending ends.
pub(crate) struct Streams {
    door: Door,
    receivers: usize,
    ends: Vec<File>,
    draft: Draft,
}

/// Where receivers come to.
enum Door {
    Unix(UnixListener, String),
    Tcp(TcpListener),
    Pipes(Vec<String>),
}

impl Streams {
    pub(crate) fn new(task: &Task) -> Outcome<Streams> {
        let door = match task.way {
            Way::Tcp => Door::Tcp(TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?),
            Way::Pipe => {
                let paths: Vec<_> = (0..task.receivers).map(|number| pipe(task.place, number)).collect();
                for path in &paths {
                    mknodat(CWD, path.as_str(), FileType::Fifo, Mode::RUSR | Mode::WUSR, 0)?;
                }
                Door::Pipes(paths)
            }
            _ => {
                let path = door(task.place);
                Door::Unix(UnixListener::bind(&path)?, path)
            }
        };
        Ok(Streams { door, receivers: task.receivers, ends: Vec::new(), draft: Draft::new(task.payload) })
    }
}

impl Outlet for Streams {
    fn address(&self) -> Outcome<String> {
        Ok(match &self.door {
            Door::Tcp(listener) => listener.local_addr()?.to_string(),
            _ => "-".into(),
        })
    }

    fn open(&mut self) -> Outcome<()> {
        for number in 0..self.receivers {
            let end = match &self.door {
                Door::Unix(listener, _) => File::from(OwnedFd::from(listener.accept()?.0)),
                Door::Tcp(listener) => {
                    let stream = listener.accept()?.0;
                    stream.set_nodelay(true)?;
                    File::from(OwnedFd::from(stream))
                }
                Door::Pipes(paths) => {
                    let end = OpenOptions::new().write(true).open(&paths[number])?;
                    // As large as a message or, where users may not have that much, as it was.
                    let _ = fcntl_setpipe_size(&end, self.draft.bytes().len().max(PIPE));
                    end
                }
            };
            self.ends.push(end);
        }
        Ok(())
    }

    fn write(&mut self, label: Label) -> Outcome<()> {
        self.draft.write(label);
        Ok(())
    }

    fn send(&mut self) -> Outcome<()> {
        for end in &mut self.ends {
            end.write_all(self.draft.bytes())?;
        }
        Ok(())
    }
}

impl Drop for Streams {
    fn drop(&mut self) {
        let paths: &[String] = match &self.door {
            Door::Unix(_, path) => std::slice::from_ref(path),
            Door::Pipes(paths) => paths,
            Door::Tcp(_) => &[],
        };
        for path in paths {
            let _ = std::fs::remove_file(path);
        }
    }
}

/// The receiving end of one.
pub(crate) struct StreamInlet {
    end: File,
    message: Vec<u8>,
}

impl StreamInlet {
    pub(crate) fn new(task: &Task, number: usize, address: &str) -> Outcome<StreamInlet> {
        let end = match task.way {
            Way::Tcp => File::from(OwnedFd::from(TcpStream::connect(address)?)),
            // Opened for both, because one without a writer is at its end.
            Way::Pipe => {
                OpenOptions::new().read(true).write(true).open(Path::new(&pipe(task.place, number)))?
            }
            _ => File::from(OwnedFd::from(UnixStream::connect(door(task.place))?)),
        };
        Ok(StreamInlet { end, message: vec![0; task.payload] })
    }
}

impl Inlet for StreamInlet {
    fn next(&mut self) -> Outcome<Label> {
        self.end.read_exact(&mut self.message)?;
        Label::read(&self.message)
    }
}

/// Where a Unix socket listens.
pub(crate) fn door(place: &str) -> String {
    format!("{place}-door")
}

fn pipe(place: &str, number: usize) -> String {
    format!("{place}-pipe-{number}")
}

/// What the system gives a pipe.
const PIPE: usize = 1 << 16;
