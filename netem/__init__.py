"""What happens to a packet between two vehicles: conditions, the network lab, and the engines that apply them."""
