"""What is read and written: whole or not at all, by one process at a time, and no file can lead
outside its folder."""
