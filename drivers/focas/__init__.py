"""A FANUC control over FOCAS2/Ethernet, without the vendor's library."""
