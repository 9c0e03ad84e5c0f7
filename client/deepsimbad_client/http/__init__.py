"""The wire: calls of the contract, the blocking and the async client, uploads."""
