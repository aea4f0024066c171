"""What velod claims of networks, hostile ones too, tried out: each module is a program that ends with what it saw."""
