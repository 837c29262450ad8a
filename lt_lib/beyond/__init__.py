"""What a referee would ask and the paper does not say: experiments beyond it, outside its scoreboard."""
