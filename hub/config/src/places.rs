//! Where each value is set: reads the sources again, key by key; the last source that has a key is its place. Refuses to
//! know the valid keys, and what their values mean.

use std::collections::BTreeMap;

use schema::Failure;
use toml::de::{DeTable, DeValue};

use crate::origin::Origin;
use crate::sources::Sources;

/// The places of all keys that are said, as `link.front.zones.radii` and `zones.radii`.
pub(crate) struct Places(BTreeMap<String, String>);

impl Places {
    /// Reads `sources`.
    ///
    /// [`schema::Kind::Configuration`] with place, value and remedy.
    pub(crate) fn of(sources: &Sources) -> Result<Places, Failure> {
        let mut places = Places(BTreeMap::new());
        for said in sources.all() {
            let (origin, _) = said?;
            let table = DeTable::parse(origin.text()).map_err(|error| origin.explain(&error))?;
            places.note(table.get_ref(), "", &origin);
        }
        Ok(places)
    }

    /// Where `key` of the link `link` is set last, if it is: a value for one link wins over one for all.
    pub(crate) fn of_link(&self, link: &str, key: &str) -> Option<&str> {
        self.of_key(&format!("link.{link}.{key}")).or_else(|| self.of_key(key))
    }

    /// Where `key` is set last, if it is.
    pub(crate) fn of_key(&self, key: &str) -> Option<&str> {
        self.0.get(key).map(String::as_str)
    }

    fn note(&mut self, table: &DeTable<'_>, path: &str, origin: &Origin) {
        for (key, value) in table.iter() {
            let path =
                if path.is_empty() { key.get_ref().to_string() } else { format!("{path}.{}", key.get_ref()) };
            match value.get_ref() {
                DeValue::Table(table) => self.note(table, &path, origin),
                DeValue::Array(links) if path == "link" => {
                    for table in links.iter().filter_map(|link| link.get_ref().as_table()) {
                        if let Some(name) = table.get("name").and_then(|name| name.get_ref().as_str()) {
                            self.note(table, &format!("link.{name}"), origin);
                        }
                    }
                }
                _ => drop(self.0.insert(path, origin.place(Some(value.span())))),
            }
        }
    }
}
