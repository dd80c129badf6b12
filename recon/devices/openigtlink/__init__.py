"""OpenIGTLink: its messages, a server and a client."""
