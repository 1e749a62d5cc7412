//! The sources of a configuration: files and flags, one layer each. Refuses to know how the layers are combined.

use std::path::{Path, PathBuf};

use schema::Failure;

use crate::layer::{Layer, link, parse, setting};
use crate::origin::Origin;

/// A layer, and where it comes from.
type Said = Result<(Origin, Layer), Failure>;

/// Where values are read from, besides the defaults.
#[derive(Clone, Debug, Default)]
pub struct Sources {
    /// Files in their order; each must exist.
    pub files: Vec<PathBuf>,
    /// `--set KEY=VALUE`, as given.
    pub set: Vec<String>,
    /// `--link NAME=PORT[,KEY=VALUE]..`, as given.
    pub links: Vec<String>,
}

impl Sources {
    /// The system's files that exist: `/etc/scanhub/scanhub.toml`, then `/etc/scanhub/conf.d/*.toml`
    /// in the order of their names.
    pub fn system() -> Vec<PathBuf> {
        let base = Path::new("/etc/scanhub");
        let mut files: Vec<_> =
            [base.join("scanhub.toml")].into_iter().filter(|file| file.exists()).collect();
        let entries = std::fs::read_dir(base.join("conf.d")).into_iter().flatten().flatten();
        let mut more: Vec<_> = entries.map(|entry| entry.path()).collect();
        more.retain(|path| path.extension().is_some_and(|extension| extension == "toml"));
        more.sort();
        files.extend(more);
        files
    }

    /// The files as they are read.
    pub(crate) fn files(&self) -> impl Iterator<Item = Said> {
        self.files.iter().map(|path| {
            let origin = Origin::read(path)?;
            let layer = parse(&origin)?;
            Ok((origin, layer))
        })
    }

    /// The links of the command line.
    pub(crate) fn links(&self) -> impl Iterator<Item = Said> {
        self.links.iter().map(|flag| {
            let remedy = "write --link NAME=PORT, for example front=/dev/ttyUSB0";
            of_flag(format!("--link {flag}"), link(flag), "no = in it", remedy)
        })
    }

    /// The single values of the command line.
    pub(crate) fn settings(&self) -> impl Iterator<Item = Said> {
        self.set.iter().map(|flag| {
            let remedy = "write --set link.NAME.KEY=VALUE, as link.front.angle=100, or for all links --set \
                          'zones.radii=[1.2,0.7]'";
            of_flag(format!("--set {flag}"), setting(flag), "not a setting", remedy)
        })
    }

    /// All of them, in the order in which they win.
    pub(crate) fn all(&self) -> impl Iterator<Item = Said> {
        self.files().chain(self.links()).chain(self.settings())
    }
}

/// A flag that says `text`; refused if it says nothing.
fn of_flag(flag: String, text: Option<String>, what: &str, remedy: &str) -> Said {
    let is_none = text.is_none();
    let origin = Origin::Flag { flag, text: text.unwrap_or_default() };
    if is_none {
        return Err(origin.refuse(None, what, remedy));
    }
    let layer = parse(&origin)?;
    Ok((origin, layer))
}
