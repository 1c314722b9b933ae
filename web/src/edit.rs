//! Sets keys in the text of a config, and keeps its comments and layout.

use toml_edit::{DocumentMut, Item, Table, TableLike, TomlError, Value};

/// Returns the text with each key, such as `learning.seed`, set to a value written as TOML.
///
/// Keys may be in a table, an inline table, dotted or quoted. An entry of a list of tables has its index, as in
/// `agents.0.at`. A value that is not TOML is written as a string, so that
/// reading the config reports it at its line.
///
/// # Errors
/// The text is not TOML.
pub fn set(text: &str, changes: &[(String, String)]) -> Result<String, TomlError> {
    let mut document: DocumentMut = text.parse()?;
    for (key, value) in changes {
        let value = value.parse().unwrap_or_else(|_| Value::from(value.as_str()));
        let names: Vec<&str> = key.split('.').collect();
        put(document.as_table_mut(), &names, value);
    }
    Ok(document.to_string())
}

fn put(table: &mut dyn TableLike, names: &[&str], mut value: Value) {
    let [name, rest @ ..] = names else { return };
    match table.get_mut(name) {
        Some(item) if rest.is_empty() => {
            // The decoration is the space and the comment around the value.
            if let Some(old) = item.as_value() {
                *value.decor_mut() = old.decor().clone();
            }
            *item = Item::Value(value);
        }
        Some(item) => {
            let (inner, rest): (Option<&mut dyn TableLike>, _) = match (item, rest[0].parse::<usize>()) {
                (Item::ArrayOfTables(list), Ok(index)) => (list.get_mut(index).map(|table| table as _), &rest[1..]),
                (Item::Value(Value::Array(list)), Ok(index)) => {
                    let entry = list.get_mut(index).and_then(Value::as_inline_table_mut);
                    (entry.map(|table| table as _), &rest[1..])
                }
                (item, _) => (item.as_table_like_mut(), rest),
            };
            // Reading the config reports a key that leads through anything else than tables and lists of tables.
            if let Some(inner) = inner {
                put(inner, rest, value);
            }
        }
        None if rest.is_empty() => drop(table.insert(name, Item::Value(value))),
        None => {
            let mut inner = Table::new();
            put(&mut inner, rest, value);
            table.insert(name, Item::Table(inner));
        }
    }
}
