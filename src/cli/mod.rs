//! One file a command; what was typed becomes ready objects here.
