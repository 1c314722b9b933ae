//! Writes classes of agents and groups of POIs as `[[agents]]` and `[[pois]]`.

use serde::Serialize;
use toml::{Table, Value};

use super::{AGENTS, AgentClass, Channel, POIS, PoiGroup, Term};
use crate::config::{Config, Motion};

impl Config {
    /// Returns the lists of tables as TOML, with nested tables in one line each.
    pub(in crate::config) fn tables_to_toml(&self) -> Vec<String> {
        let agents = self.agents.iter().map(|class| text(AGENTS, class, AgentClass::KEYS));
        agents.chain(self.pois.iter().map(|group| text(POIS, group, PoiGroup::KEYS))).collect()
    }
}

fn text(list: &str, of: &impl Serialize, keys: &[&str]) -> String {
    let table = Table::try_from(of).expect("numbers, words, lists and tables of them are TOML");
    let lines = present(&table, keys).map(|(key, value)| match (key, value) {
        ("motion", Value::Table(motion)) => {
            format!("{key} = {}\n", inline(motion, &[&["kind"], Motion::KEYS].concat()))
        }
        ("in", Value::Table(region)) => {
            let region: Vec<&str> = region.keys().map(String::as_str).collect();
            format!("{key} = {}\n", inline(value.as_table().unwrap_or(&Table::new()), &region))
        }
        ("senses", Value::Array(channels)) => format!("{key} = [\n{}]\n", rows(channels, Channel::KEYS)),
        ("rule", Value::Array(terms)) => format!("{key} = [\n{}]\n", rows(terms, Term::KEYS)),
        _ => format!("{key} = {value}\n"),
    });
    format!("[[{list}]]\n{}", lines.collect::<String>())
}

fn rows(tables: &[Value], keys: &[&str]) -> String {
    tables.iter().filter_map(Value::as_table).map(|table| format!("    {},\n", inline(table, keys))).collect()
}

fn inline(table: &Table, keys: &[&str]) -> String {
    let items: Vec<_> = present(table, keys).map(|(key, value)| format!("{key} = {value}")).collect();
    format!("{{ {} }}", items.join(", "))
}

/// Returns the keys that a table has, in order, with their values.
fn present<'t, 'k>(table: &'t Table, keys: &'k [&str]) -> impl Iterator<Item = (&'k str, &'t Value)> {
    keys.iter().filter_map(|key| Some((*key, table.get(*key)?)))
}
