"""Learnt policies act again: replays, rewound exploration, chains."""
