//! The name of a link's source, as it is written in a configuration: a serial line, a serial server or a recording.
//! Refuses to know whether it exists.

use std::path::PathBuf;

/// Where the bytes of a link come from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Source {
    /// A serial line.
    Tty(PathBuf),
    /// A line behind a serial server (`tcp:HOST:PORT`), which must be set to the link's rate.
    Tcp {
        /// Name or address, an IPv6 address without its brackets.
        host: String,
        /// Port in raw TCP mode.
        port: u16,
    },
    /// A recording (`file:PATH`), paced by its scan period or, with `?rate=max`, as fast as it can be read.
    File {
        /// The recording.
        path: PathBuf,
        /// Whether its pace is kept.
        paced: bool,
    },
}

impl Source {
    /// The source as it is written in a configuration.
    pub fn name(&self) -> String {
        match self {
            Source::Tty(path) => path.display().to_string(),
            Source::Tcp { host, port } if host.contains(':') => format!("tcp:[{host}]:{port}"),
            Source::Tcp { host, port } => format!("tcp:{host}:{port}"),
            Source::File { path, paced: true } => format!("file:{}", path.display()),
            Source::File { path, paced: false } => format!("file:{}?rate=max", path.display()),
        }
    }

    /// The source that `text` is.
    ///
    /// # Errors
    ///
    /// What is wrong with it, in words.
    pub fn parse(text: &str) -> Result<Source, &'static str> {
        if let Some(server) = text.strip_prefix("tcp:") {
            let (host, port) = server.rsplit_once(':').ok_or("tcp: without a port: write tcp:HOST:PORT")?;
            let port =
                port.parse().ok().filter(|&port| port > 0).ok_or("tcp: the port is a number to 65535")?;
            let bare = host.strip_prefix('[').and_then(|host| host.strip_suffix(']'));
            return match bare.unwrap_or(host) {
                "" => Err("tcp: without a host: write tcp:HOST:PORT"),
                host if bare.is_none() && host.contains(':') => {
                    Err("an IPv6 address stands in brackets: tcp:[ADDRESS]:PORT")
                }
                host => Ok(Source::Tcp { host: host.to_owned(), port }),
            };
        }
        let Some(file) = text.strip_prefix("file:") else {
            return if text.is_empty() { Err("the port is empty") } else { Ok(Source::Tty(text.into())) };
        };
        let (path, paced) = match file.split_once('?') {
            None => (file, true),
            Some((path, "rate=max")) => (path, false),
            Some(_) => return Err("the only option of a file is rate=max"),
        };
        if path.is_empty() {
            Err("the file has no name")
        } else {
            Ok(Source::File { path: path.into(), paced })
        }
    }
}
